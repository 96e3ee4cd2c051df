/* Simulate a whole run with an exported model. */
#include "model.h"

int run(const double *t, const double *u, int n, const double *x0, double longest, double *y)
{
    CartModel model = {.p = cart_parameters};
    int fine = 1;

    if (longest > 0.0)
        model.p.max_step = longest;
    cart_model_start(&model, x0 ? x0 : cart_rest);
    for (int k = 0; k < n; k++) {
        for (int i = 0; i < CARTS; i++)
            y[i * n + k] = model.y[i];
        if (k + 1 < n)
            fine = cart_model_step(&model, u[k], t[k + 1] - t[k]) && fine;
    }
    return fine;
}
