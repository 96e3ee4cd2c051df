#include "bench.h"

#include <string.h>

#include "number.h"

#define LONGEST_LINE (6 * (LONGEST_INTEGER + 1)) /* three counts, target, duty, time */

/* ------------------------------------------------------------------ output */

static uint8_t room(const Ring *ring) { return (uint8_t)(ring->taken - ring->written - 1); }

/* Send a whole text or nothing: the time stamps show the host a missing line, but nothing would
 * show it that a line is only half of one. */
static void send(Bench *bench, const char *text, size_t length)
{
    if (length > room(&bench->output))
        return;
    while (length--)
        bench->output.bytes[bench->output.written++] = (uint8_t)*text++;
}

int16_t bench_take(Bench *bench)
{
    Ring *ring = &bench->output;
    return ring->taken == ring->written ? -1 : ring->bytes[ring->taken++];
}

static void send_line(Bench *bench, const int32_t *counts, int32_t target, int16_t duty,
                      uint32_t ms)
{
    char line[LONGEST_LINE], *end = line;
    for (uint8_t i = 0; i < bench->settings.encoders; ++i) {
        end += write_integer(end, counts[i]);
        *end++ = ':';
    }
    end += write_integer(end, target);
    *end++ = ':';
    end += write_integer(end, duty);
    *end++ = ':';
    end += write_integer(end, (int32_t)ms);
    *end++ = '\n';
    send(bench, line, (size_t)(end - line));
}

/* ------------------------------------------------------------------ input */

/* Forget everything except the settings and the bytes not yet sent. */
static void reset(Bench *bench)
{
    bench->state = STOPPED;
    bench->zeroed = false;
    bench->watched = bench->heard = false;
    bench->chirp_end = 0.0;
    memset(&bench->gains, 0, sizeof bench->gains);
    bench->gains.loop = PID_LOOP;
}

void bench_init(Bench *bench, const BenchSettings *settings)
{
    memset(bench, 0, sizeof *bench);
    bench->settings = *settings;
    bench->reader.encoders = settings->encoders;
    reset(bench);
}

static void start(Bench *bench, const double *fields)
{
    bench->wave = (Wave){
        .shape = (char)fields[0],
        .frequency = fields[3],
        .amplitude = fields[4],
        .end = bench->chirp_end > 0.0 ? bench->chirp_end : CHIRP_SPAN * fields[3],
        .duration = fields[5] / fields[3],
    };
    bench->law = bench->gains;
    if (fields[1] == 'o')
        bench->law.loop = OPEN_LOOP;
    bench->followed = fields[2] == 't';
    bench->duty = 0;
    bench->state = STARTING;
}

static void obey(Bench *bench, const Command *command)
{
    const double *fields = command->fields;
    const uint8_t gains = 2 * bench->settings.encoders;
    switch (command->letter) {
    case 'd':
        start(bench, fields);
        break;
    case 'g':
        bench->gains.loop = PID_LOOP;
        bench->gains.pid = (Pid){.kp = fields[0], .ki = fields[1], .kd = fields[2]};
        break;
    case 'f':
        bench->gains.loop = STATE_LOOP;
        memcpy(bench->gains.state_feedback.gains, fields, gains * sizeof *fields);
        bench->gains.state_feedback.prefilter = fields[gains];
        break;
    case 'c':
        bench->chirp_end = fields[0];
        break;
    case 'z':
        reset(bench);
        break;
    case 's':
        bench->state = STOPPED;
        break;
    case 'k':
        bench->watched = bench->heard = true;
        break;
    case '?':
        send(bench, bench->settings.description, strlen(bench->settings.description));
        break;
    }
}

void bench_receive(Bench *bench, uint8_t byte)
{
    const uint8_t found = command_receive(&bench->reader, byte);
    if (found & STOP_FOUND)
        bench->state = STOPPED;
    if (found & COMMAND_FOUND)
        obey(bench, &bench->reader.command);
}

/* ------------------------------------------------------------------ once a period */

static int16_t clipped(double effort)
{
    if (effort > FULL_SCALE)
        return FULL_SCALE;
    if (effort < -FULL_SCALE)
        return -FULL_SCALE;
    return (int16_t)nearest_count(effort);
}

/* The duty that acts from now on. */
static int16_t follow(Bench *bench, int32_t target, const int32_t *counts)
{
    const double period = bench->settings.period;
    const uint8_t encoders = bench->settings.encoders;
    const int16_t computed_before = bench->duty;
    Law *law = &bench->law;
    switch (law->loop) {
    case PID_LOOP:
        return clipped(pid_effort(&law->pid, (double)target - counts[bench->followed], period));
    case STATE_LOOP:
        bench->duty =
            clipped(state_feedback_effort(&law->state_feedback, target, counts, encoders, period));
        return computed_before;
    default:
        return clipped(target);
    }
}

int16_t bench_tick(Bench *bench, const int32_t *counts, uint32_t stamp_ms, uint32_t now_ms)
{
    const uint8_t encoders = bench->settings.encoders;
    if (!bench->zeroed)
        memcpy(bench->zero, counts, encoders * sizeof *counts);
    bench->zeroed = true;
    int32_t y[MOST_ENCODERS];
    for (uint8_t i = 0; i < encoders; ++i) /* unsigned, because a counter may overflow */
        y[i] = (int32_t)((uint32_t)counts[i] - (uint32_t)bench->zero[i]);

    if (bench->heard)
        bench->last_heard = now_ms;
    bench->heard = false;
    if (bench->watched && now_ms - bench->last_heard >= WATCHDOG_MS)
        bench->state = STOPPED;

    if (bench->state == STARTING) {
        bench->state = RUNNING;
        bench->since = stamp_ms;
        state_feedback_start(&bench->law.state_feedback, y, encoders);
    }
    const uint32_t ms = stamp_ms - bench->since;
    if (bench->state == RUNNING && ms >= 1e3 * bench->wave.duration)
        bench->state = STOPPED;
    if (bench->state == STOPPED)
        return 0;

    const int32_t target = wave_target(&bench->wave, 1e-3 * ms);
    const int16_t duty = follow(bench, target, y);
    send_line(bench, y, target, duty, ms);
    return duty;
}
