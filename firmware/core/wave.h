/* The target over a run, by its wave. */
#ifndef CARTLAB_WAVE_H
#define CARTLAB_WAVE_H

#include <stdint.h>

#define PULSE_TIME 0.05 /* s for which a delta is on */
#define CHIRP_SPAN 20.0 /* default ratio of a chirp's last frequency to its first */

typedef struct {
    char shape; /* d delta, q square, s sine, t triangle, w sawtooth, c chirp */
    double amplitude;
    double frequency; /* Hz; a chirp starts there */
    double end;       /* Hz; a chirp ends there */
    double duration;  /* s of the whole run, which a chirp sweeps */
} Wave;

/* The target t seconds into the run, to the nearest count. */
int32_t wave_target(const Wave *wave, double t);

/* Round to the nearest count, halves up. */
int32_t nearest_count(double value);

#endif
