/* Numbers from text and into it, without the C library's printf and scanf: those take kilobytes of
 * an 8-bit controller's memory, and some fetch theirs from a heap. */
#ifndef CARTLAB_NUMBER_H
#define CARTLAB_NUMBER_H

#include <stdbool.h>
#include <stdint.h>

#define LONGEST_INTEGER 11 /* characters of -2147483648 */

/* Read a decimal number such as -12, +.5 or 3.2e-4, or where `whole` is set digits and a sign only.
 * False: the text is none, or its size is out of reach; `value` is then left alone.
 *
 * Up to fifteen digits and an exponent within 22 come out correctly rounded where double has 64
 * bits: digits and power of ten are then exact. The host never sends more than nine. */
bool read_number(const char *text, bool whole, double *value);

/* Write `value` in decimal digits and return how many characters that took. */
uint8_t write_integer(char *text, int32_t value);

#endif
