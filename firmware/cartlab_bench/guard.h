/* The processor's own watchdog: if the ticks stop, it resets the board, which cuts the motor.
 *
 * A broken encoder wire near the motor's wires can change so often that its interrupts leave no
 * time for anything else. The watchdog of the core cannot help then: it runs in the tick. */
#ifndef CARTLAB_GUARD_H
#define CARTLAB_GUARD_H

#if defined(__AVR__)

#include <avr/wdt.h>

/* After a reset by the watchdog it is still on, and eight times as fast: call this first. */
static void guard_begin() { wdt_enable(WDTO_120MS); }

static void guard_feed() { wdt_reset(); }

#else

/* Other boards are many times as fast, and have no guard here. */
static void guard_begin() {}

static void guard_feed() {}

#endif

#endif
