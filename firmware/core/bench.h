/* A bench's controller between its serial line and its motor.
 *
 * The hardware around it calls bench_receive for each byte that arrives and bench_tick once a
 * period, and sends the bytes from bench_take. This code uses no pin, clock or interrupt, so it
 * runs unchanged on an 8-bit controller, on a Teensy, and in the tests on a computer. */
#ifndef CARTLAB_BENCH_H
#define CARTLAB_BENCH_H

#include <stdbool.h>
#include <stdint.h>

#include "command.h"
#include "control.h"
#include "wave.h"

#ifdef __cplusplus
extern "C" {
#endif

#define FULL_SCALE 4096 /* duty counts: the motor's full voltage */
#define WATCHDOG_MS 100 /* ms without a heartbeat until the motor is cut */

typedef struct {
    uint8_t encoders;        /* two or three */
    double period;           /* s from tick to tick */
    const char *description; /* the answer to a query, its line feed included */
} BenchSettings;

/* Bytes to send. The 8-bit indices wrap around with the buffer. */
typedef struct {
    uint8_t bytes[256];
    uint8_t written, taken;
} Ring;

typedef enum { OPEN_LOOP, PID_LOOP, STATE_LOOP } Loop;

/* The control law: the gains received last, and the law's state during a run. */
typedef struct {
    Loop loop;
    Pid pid;
    StateFeedback state_feedback;
} Law;

typedef struct {
    BenchSettings settings;
    CommandReader reader;
    Ring output;

    bool zeroed; /* false: the next counts become the zero */
    int32_t zero[MOST_ENCODERS];
    Law gains;        /* of the next runs */
    double chirp_end; /* Hz; 0: not set */

    enum { STOPPED, STARTING, RUNNING } state;
    Wave wave;
    Law law;
    uint8_t followed; /* the encoder, from 0, that a PID follows */
    int16_t duty;     /* that state feedback computed at the last tick */
    uint32_t since;   /* ms of the bench's clock when the run began */

    bool watched, heard; /* a heartbeat came since the reset; since the last tick */
    uint32_t last_heard; /* ms of wall time */
} Bench;

void bench_init(Bench *bench, const BenchSettings *settings);

/* Take a byte from the line. Its command is carried out at the next tick. */
void bench_receive(Bench *bench, uint8_t byte);

/* Return the duty that is to act from now on, within +-FULL_SCALE.
 *
 * counts:   of the encoders since power-on; after a reset, the next counts become the zero.
 * stamp_ms: the bench's clock, used for lines, waves and run times.
 * now_ms:   wall time, used for the watchdog only; a real bench has one clock for both. */
int16_t bench_tick(Bench *bench, const int32_t *counts, uint32_t stamp_ms, uint32_t now_ms);

/* The next byte to send; -1: there is none. */
int16_t bench_take(Bench *bench);

#ifdef __cplusplus
}
#endif

#endif
