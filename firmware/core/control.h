/* Control laws from target to motor: none, PID on one encoder, state feedback on all encoders.
 *
 * A law is computed once per period T and gives an effort in duty counts. */
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
 * Encoders give positions. An observer estimates the velocities: it predicts each position one
 * tick ahead at constant velocity, and at the next tick corrects the velocity by half of the
 * prediction error. A half removes three quarters of the encoder's rounding noise, and a wrong
 * start is forgotten in a few ticks.
 *
 * The effort acts from the next tick on, so there is a whole period to compute it. Therefore the
 * gains multiply the predicted state: the one at the moment when the effort begins to act. */
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
