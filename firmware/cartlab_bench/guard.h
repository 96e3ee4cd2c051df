/* The processor's own watchdog: it resets the board, which lets go of the motor, where ticks stop.
 *
 * A broken encoder wire beside the motor's can change so often that its interrupts leave no time
 * for anything else, nor for the watchdog of the core, which lives in the tick. */
#ifndef CARTLAB_GUARD_H
#define CARTLAB_GUARD_H

#if defined(__AVR__)

#include <avr/wdt.h>

/* After a reset of its own it is on already and eight times as quick: begin with this. */
static void guard_begin() { wdt_enable(WDTO_120MS); }

static void guard_feed() { wdt_reset(); }

#else

/* Other boards have many times the pace, and no guard here. */
static void guard_begin() {}

static void guard_feed() {}

#endif

#endif
