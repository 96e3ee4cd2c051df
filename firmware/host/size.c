/* What a program in another language must know to hold a bench: its size in bytes. */
#include <stddef.h>

#include "bench.h"

size_t bench_size(void);
size_t bench_size(void) { return sizeof(Bench); }
