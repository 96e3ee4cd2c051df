#include "quadrature.h"

int8_t quadrature_step(uint8_t from, uint8_t to)
{
    static const int8_t STEPS[4][4] = {
        /* to:   00      01      10      11 */
        /* 00 */ {0, -1, 1, MISSED},
        /* 01 */ {1, 0, MISSED, -1},
        /* 10 */ {-1, MISSED, 0, 1},
        /* 11 */ {MISSED, 1, -1, 0},
    };
    return STEPS[from & 3][to & 3];
}

void quadrature_update(Quadrature *encoder, uint8_t state)
{
    const int8_t step = quadrature_step(encoder->state, state);
    if (step == MISSED)
        ++encoder->missed;
    else
        encoder->count += step;
    encoder->state = state & 3;
}
