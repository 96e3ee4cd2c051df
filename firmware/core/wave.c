#include "wave.h"

#include <math.h>

#define TWO_PI 6.283185307179586

/* The turns of a sweep until t: the integral of a frequency that grows by the same factor in every
 * second. */
static double chirp_turns(const Wave *wave, double t)
{
    const double span = wave->end / wave->frequency;
    if (span == 1.0)
        return wave->frequency * t;
    const double grown = wave->duration / log(span); /* s in which it grows e-fold */
    return wave->frequency * grown * (exp(t / grown) - 1.0);
}

/* The wave at unit amplitude. */
static double shape_at(const Wave *wave, double t)
{
    const double turns = t * wave->frequency;
    const double phase = turns - floor(turns); /* 0 ... 1 through a period */
    switch (wave->shape) {
    case 'd': /* a short pulse as the period begins */
        return phase < PULSE_TIME * wave->frequency ? 1.0 : 0.0;
    case 'q': /* zero for half a period, then one */
        return phase < 0.5 ? 0.0 : 1.0;
    case 's':
        return sin(TWO_PI * phase);
    case 't': /* up to 1, down to -1, up to zero */
        return 1.0 - 4.0 * fabs(phase < 0.75 ? phase - 0.25 : phase - 1.25);
    case 'w': /* up to 1, jump to -1, up to zero */
        return phase < 0.5 ? 2.0 * phase : 2.0 * phase - 2.0;
    default:
        return sin(TWO_PI * chirp_turns(wave, t));
    }
}

int32_t wave_target(const Wave *wave, double t)
{
    return nearest_count(wave->amplitude * shape_at(wave, t));
}

int32_t nearest_count(double value) { return (int32_t)floor(value + 0.5); }
