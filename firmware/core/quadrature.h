/* Counts from the two square waves of an incremental encoder.
 *
 * Channels A and B are a quarter of a period apart, so their common state goes through
 *
 *     A  0 1 1 0 0          forwards: 00 -> 10 -> 11 -> 01 -> 00 ...
 *     B  0 0 1 1 0          backwards the other way round
 *
 * and every step along this ring is a count, four in a period. A and B never change together: if
 * they seem to, an edge was missed. */
#ifndef CARTLAB_QUADRATURE_H
#define CARTLAB_QUADRATURE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MISSED 2 /* result of quadrature_step if the new state is not next to the old one */

typedef struct {
    int32_t count;
    uint16_t missed; /* impossible transitions: each puts the count off by two, up or down */
    uint8_t state;   /* 2 A + B, as last seen */
} Quadrature;

/* The step from one state to another: -1, 0, 1 or MISSED. */
int8_t quadrature_step(uint8_t from, uint8_t to);

/* Take a new state of the channels; call it at every edge, from an interrupt. */
void quadrature_update(Quadrature *encoder, uint8_t state);

#ifdef __cplusplus
}
#endif

#endif
