#include "control.h"

double pid_effort(Pid *pid, double error, double period)
{
    pid->integral += error * period;
    const double slope = (error - pid->last) / period;
    pid->last = error;
    return pid->kp * error + pid->ki * pid->integral + pid->kd * slope;
}

void state_feedback_start(StateFeedback *law, const int32_t *counts, uint8_t encoders)
{
    for (uint8_t i = 0; i < encoders; ++i) {
        law->x[i] = counts[i];
        law->v[i] = 0.0;
    }
}

double state_feedback_effort(StateFeedback *law, double target, const int32_t *counts,
                             uint8_t encoders, double period)
{
    double effort = law->prefilter * target;
    for (uint8_t i = 0; i < encoders; ++i) {
        law->v[i] += VELOCITY_CORRECTION / period * (counts[i] - law->x[i]);
        law->x[i] = counts[i] + period * law->v[i];
        effort -= law->gains[2 * i] * law->x[i] + law->gains[2 * i + 1] * law->v[i];
    }
    return effort;
}
