/* Feed the core with bytes as from a noisy line, in a build that checks every access to memory.
 *
 *     fuzz SEED ROUNDS
 *
 * The program fails if a duty is beyond full scale or a line is cut short. */
#include <assert.h>
#include <stdlib.h>
#include <string.h>

#include "bench.h"

static uint32_t state;

/* A whole number below `end`, by Marsaglia's xorshift (J. Stat. Software 8 (14), 2003). */
static uint32_t draw(uint32_t end)
{
    state ^= state << 13;
    state ^= state >> 17;
    state ^= state << 5;
    return state % end;
}

static void receive_text(Bench *bench, const char *text)
{
    while (*text)
        bench_receive(bench, (uint8_t)*text++);
}

/* A valid field, or noise. */
static void receive_field(Bench *bench)
{
    static const char *FIELDS[] = {"d", "g",        "f",   "c",   "z",     "s",    "k",
                                   "?", "h",        "q",   "w",   "t",     "o",    "0",
                                   "1", "-1000000", "2.5", "1e9", "-3e-9", "1000", "0.001"};
    const uint32_t noise = draw(8) ? 0 : draw(50);
    for (uint32_t i = 0; i < noise; ++i)
        bench_receive(bench, (uint8_t)draw(256));
    receive_text(bench, FIELDS[draw(sizeof FIELDS / sizeof *FIELDS)]);
    bench_receive(bench, ';');
}

static void receive_start(Bench *bench)
{
    static const char *STARTS[] = {"d;s;o;o;1e3;1000000;1000000;",
                                   "d;c;c;t;1e-3;-1000000;1;",
                                   "d;t;c;o;3;900;9;",
                                   "f;1e9;-1e9;1e9;1e9;1e9;1e9;-1e9;d;q;c;o;2;5000;4;",
                                   "g;1e9;1e9;1e9;d;w;c;t;7;500;70;",
                                   "c;1e3;d;c;o;o;.001;4000;1;",
                                   "z;k;"};
    receive_text(bench, STARTS[draw(sizeof STARTS / sizeof *STARTS)]);
}

int main(int argc, char **argv)
{
    assert(argc == 3);
    state = (uint32_t)atol(argv[1]) | 1;
    const BenchSettings settings = {
        .encoders = (uint8_t)(2 + draw(2)), .period = 1e-3, .description = "?cartlab/1 fuzz\n"};
    Bench bench;
    bench_init(&bench, &settings);
    uint32_t clock = 0;
    int colons = 0;
    bool answer = false;
    for (long rounds = atol(argv[2]); rounds--;) {
        if (!draw(4))
            receive_field(&bench);
        if (!draw(16))
            receive_start(&bench);
        int32_t counts[MOST_ENCODERS];
        for (int i = 0; i < MOST_ENCODERS; ++i)
            counts[i] = (int32_t)(draw(3) ? draw(20000) : draw(UINT32_MAX));
        clock += draw(100) ? draw(3) : draw(UINT32_MAX);
        const int16_t duty = bench_tick(&bench, counts, clock, clock);
        assert(-FULL_SCALE <= duty && duty <= FULL_SCALE);
        for (int16_t byte; draw(50) && (byte = bench_take(&bench)) >= 0;) {
            answer = answer || byte == '?';
            colons += byte == ':';
            if (byte == '\n') {
                assert(answer || colons == settings.encoders + 2);
                colons = 0;
                answer = false;
            }
        }
    }
    return 0;
}
