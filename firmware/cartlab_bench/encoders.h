/* Counts of the encoders, kept by interrupts. */
#ifndef CARTLAB_ENCODERS_H
#define CARTLAB_ENCODERS_H

#include <quadrature.h>

static volatile Quadrature encoders[MOST_ENCODERS];

#if defined(__AVR__)

/* digitalRead needs 60 cycles to find a pin's register. Found once, a read needs two. */
static struct {
    volatile uint8_t *port;
    uint8_t mask;
} inputs[MOST_ENCODERS][2];

static void channels_begin(uint8_t encoder)
{
    for (uint8_t i = 0; i < 2; ++i) {
        const uint8_t pin = ENCODER_PINS[encoder][i];
        inputs[encoder][i].port = portInputRegister(digitalPinToPort(pin));
        inputs[encoder][i].mask = digitalPinToBitMask(pin);
    }
}

static inline uint8_t channels(uint8_t encoder)
{
    return (*inputs[encoder][0].port & inputs[encoder][0].mask ? 2 : 0) |
           (*inputs[encoder][1].port & inputs[encoder][1].mask ? 1 : 0);
}

#else

static void channels_begin(uint8_t) {}

static inline uint8_t channels(uint8_t encoder)
{
    return digitalRead(ENCODER_PINS[encoder][0]) << 1 | digitalRead(ENCODER_PINS[encoder][1]);
}

#endif

/* An interrupt handler is not told which pin changed, so each encoder has its own handler. */
template <uint8_t encoder> static void edge()
{
    quadrature_update((Quadrature *)&encoders[encoder], channels(encoder));
}

static void (*const EDGES[MOST_ENCODERS])() = {edge<0>, edge<1>, edge<2>};

static void encoders_begin()
{
    for (uint8_t i = 0; i < ENCODERS; ++i) {
        for (uint8_t pin : ENCODER_PINS[i])
            pinMode(pin, INPUT_PULLUP);
        channels_begin(i);
        encoders[i].state = channels(i);
        for (uint8_t pin : ENCODER_PINS[i])
            attachInterrupt(digitalPinToInterrupt(pin), EDGES[i], CHANGE);
    }
}

static void encoders_read(int32_t *counts)
{
    noInterrupts(); /* so that no count changes while its four bytes are read */
    for (uint8_t i = 0; i < ENCODERS; ++i)
        counts[i] = encoders[i].count;
    interrupts();
}

#endif
