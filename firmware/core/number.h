/* Read and write numbers as text, without the C library's printf and scanf: these need kilobytes of
 * an 8-bit controller's memory, and some of them use the heap. */
#ifndef CARTLAB_NUMBER_H
#define CARTLAB_NUMBER_H

#include <stdbool.h>
#include <stdint.h>

#define LONGEST_INTEGER 11 /* characters of -2147483648 */

/* Read a decimal number such as -12, +.5 or 3.2e-4; with `whole`, only digits and a sign.
 * False: the text is not a number, or too large or small; `value` is then unchanged.
 *
 * If double has 64 bits, numbers of up to fifteen digits and an exponent within 22 are correctly
 * rounded, because digits and power of ten are exact. The host sends at most nine digits. */
bool read_number(const char *text, bool whole, double *value);

/* Write `value` in decimal digits and return the number of characters. */
uint8_t write_integer(char *text, int32_t value);

#endif
