/* The laws between target and motor: none, PID on one encoder, state feedback on all.
 *
 * They are sampled once a period T and give an effort in duty counts. */
#ifndef CARTLAB_CONTROL_H
#define CARTLAB_CONTROL_H

#include <stdint.h>

#include "command.h"

/* Effort = kp e + ki (sum of e T) + kd (change of e)/T, where e = target - count. Before the first
 * tick e is zero. The effort acts at once. */
typedef struct {
    double kp, ki, kd;
    double integral, last;
} Pid;

double pid_effort(Pid *pid, double error, double period);

/* Effort = prefilter target - gains [x1, v1, x2, v2, ...].
 *
 * Encoders give positions. An observer finds the velocities: it predicts each position one tick
 * ahead at constant velocity, and at the next tick puts half of what the prediction missed down to
 * the velocity. A half keeps three quarters of the encoder's rounding noise out, and forgets a
 * wrong start in a few ticks.
 *
 * The effort acts from the next tick on, so that there is a whole period to compute it, and the
 * gains multiply the prediction: the state at the moment the effort begins to act. */
#define VELOCITY_CORRECTION 0.5

typedef struct {
    double gains[2 * MOST_ENCODERS];
    double prefilter;
    double x[MOST_ENCODERS], v[MOST_ENCODERS]; /* predicted, counts and counts/s */
} StateFeedback;

/* The observer starts at the first reading, at rest. */
void state_feedback_start(StateFeedback *law, const int32_t *counts, uint8_t encoders);
double state_feedback_effort(StateFeedback *law, double target, const int32_t *counts,
                             uint8_t encoders, double period);

#endif
