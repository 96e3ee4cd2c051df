#include "number.h"

#include <float.h>
#include <stddef.h>

#define MOST_DIGITS UINT64_C(100000000000000000) /* with one digit more it still fits in 64 bits */
#define LARGEST_EXPONENT 1000                    /* beyond it everything is infinite or nothing */

static bool is_digit(char c) { return c >= '0' && c <= '9'; }

/* Step over a sign; true if it is a minus. */
static bool take_sign(const char **text)
{
    const bool minus = **text == '-';
    if (minus || **text == '+')
        ++*text;
    return minus;
}

static double power_of_ten(uint16_t exponent)
{
    double power = 1.0;
    for (double factor = 10.0; exponent; exponent >>= 1, factor *= factor)
        if (exponent & 1)
            power *= factor;
    return power;
}

bool read_number(const char *text, bool whole, double *value)
{
    const bool negative = take_sign(&text);
    uint64_t digits = 0;  /* the number without its point ... */
    int16_t exponent = 0; /* ... and the power of ten that puts the point back */
    bool any = false, fraction = false;
    for (;; ++text) {
        if (*text == '.' && !fraction && !whole) {
            fraction = true;
        } else if (is_digit(*text)) {
            any = true;
            if (digits < MOST_DIGITS) {
                digits = 10 * digits + (uint64_t)(*text - '0');
                exponent -= fraction;
            } else {
                exponent += !fraction; /* one digit more than fits: only its place counts */
            }
        } else {
            break;
        }
    }
    if (!any)
        return false;
    if ((*text == 'e' || *text == 'E') && !whole) {
        ++text;
        const bool down = take_sign(&text);
        if (!is_digit(*text))
            return false;
        int16_t power = 0;
        for (; is_digit(*text); ++text)
            if (power < LARGEST_EXPONENT)
                power = (int16_t)(10 * power + (*text - '0'));
        exponent = (int16_t)(exponent + (down ? -power : power));
    }
    if (*text)
        return false;
    const double power = power_of_ten((uint16_t)(exponent < 0 ? -exponent : exponent));
    double number = (double)digits;
    if (digits) /* zero times an infinite power would be no number */
        number = exponent < 0 ? number / power : number * power;
    if (!(number <= DBL_MAX))
        return false;
    *value = negative ? -number : number;
    return true;
}

uint8_t write_integer(char *text, int32_t value)
{
    /* Counting how often each power of ten fits spares ten divisions of 32 bits, some 600 cycles
     * each on a processor that cannot divide. */
    static const uint32_t POWERS[] = {1000000000, 100000000, 10000000, 1000000, 100000,
                                      10000,      1000,      100,      10,      1};
    uint32_t rest = value < 0 ? 0 - (uint32_t)value : (uint32_t)value;
    uint8_t length = 0;
    if (value < 0)
        text[length++] = '-';
    bool leading = true;
    for (size_t i = 0; i < sizeof POWERS / sizeof *POWERS; ++i) {
        char digit = '0';
        for (; rest >= POWERS[i]; rest -= POWERS[i])
            ++digit;
        leading = leading && digit == '0' && POWERS[i] > 1;
        if (!leading)
            text[length++] = digit;
    }
    return length;
}
