/* The bench's controller on an Arduino Mega or a Teensy: pins, clock and serial line around the
 * core, which knows none of them. board.h says what is wired where. */
#include <bench.h>

#include "board.h"
#include "encoders.h"
#include "guard.h"
#include "motor.h"

#define TEXT(x) #x
#define TEXT_OF(x) TEXT(x)

#define PERIOD_US ((uint32_t)(1e6 * PERIOD + 0.5))

static const BenchSettings SETTINGS = {
    ENCODERS,
    PERIOD,
    "?cartlab/1 name=" NAME " encoders=" TEXT_OF(ENCODERS) " carts=" TEXT_OF(CARTS)
    " period=" TEXT_OF(PERIOD) " baud=" TEXT_OF(BAUD) " commands=cfks"
    " input=" INPUT_PER_COUNT " position=" POSITION_PER_COUNT "\n",
};

static Bench bench;

/* ------------------------------------------------------------------ time */

static uint32_t due_us;   /* of micros(), when the next tick is due; goes round every 72 minutes */
static uint32_t clock_ms; /* of the last tick, whole milliseconds ... */
static uint32_t clock_us; /* ... and the rest */

/* True once a period. What the processor was too busy for is left out, and the clock shows it. */
static bool tick_is_due()
{
    bool is_due = false;
    while (micros() - due_us < UINT32_MAX / 2) { /* the difference is not yet below zero */
        due_us += PERIOD_US;
        clock_us += PERIOD_US;
        clock_ms += clock_us / 1000;
        clock_us %= 1000;
        is_due = true;
    }
    return is_due;
}

static void tick()
{
    int32_t counts[MOST_ENCODERS];
    encoders_read(counts);
    motor_drive(bench_tick(&bench, counts, clock_ms, clock_ms));
    guard_feed();
}

/* ------------------------------------------------------------------ Arduino's two */

void setup()
{
    guard_begin();
    motor_begin();
    encoders_begin(); /* from here on interrupts may take all the time there is */
    bench_init(&bench, &SETTINGS);
    Serial.begin(BAUD);
    due_us = micros();
}

void loop()
{
    /* A few at a time: however fast bytes come, the watchdog in the tick has its turn. */
    for (uint8_t left = 64; left && Serial.available(); --left)
        bench_receive(&bench, (uint8_t)Serial.read());
    if (tick_is_due())
        tick();
    while (Serial.availableForWrite()) { /* never wait for a host that does not read */
        const int16_t byte = bench_take(&bench);
        if (byte < 0)
            break;
        Serial.write((uint8_t)byte);
    }
}
