/* Dynamic programming over a grid of states (a, b), backwards in time: the check of optima that owes nothing to their search.

   What precedes this file defines PERIODIC, whether a wraps, and the function model: the state that follows (a, b) under u, the
   cost of the step, and whether the episode ends there. Values between nodes are interpolated by cubics through four nodes. */

#include <math.h>
#include <stdint.h>

typedef struct { double low[2], high[2], limit; int64_t nodes[2], actions; } Grid;

static void weights(double t, double w[4]) {
    w[0] = -t * (t - 1) * (t - 2) / 6;
    w[1] = (t + 1) * (t - 1) * (t - 2) / 2;
    w[2] = -(t + 1) * t * (t - 2) / 2;
    w[3] = (t + 1) * t * (t - 1) / 6;
}

static double value(const Grid *g, const float *v, double a, double b) {
    const int64_t n = g->nodes[0], m = g->nodes[1];
    double s = (a - g->low[0]) / (g->high[0] - g->low[0]) * (PERIODIC ? n : n - 1);
    double r = (b - g->low[1]) / (g->high[1] - g->low[1]) * (m - 1);
    int64_t i = (int64_t)floor(s), j = (int64_t)floor(r);
    if (!PERIODIC)
        i = i < 1 ? 1 : i > n - 3 ? n - 3 : i;
    j = j < 1 ? 1 : j > m - 3 ? m - 3 : j;
    double ws[4], wr[4], sum = 0, least = INFINITY, most = -INFINITY;
    weights(s - i, ws);
    weights(r - j, wr);
    for (int p = 0; p < 4; ++p) {
        const int64_t row = PERIODIC ? ((i + p - 1) % n + n) % n : i + p - 1;
        const float *at = v + row * m + j - 1;
        sum += ws[p] * (wr[0] * at[0] + wr[1] * at[1] + wr[2] * at[2] + wr[3] * at[3]);
        if (p == 1 || p == 2)
            for (int q = 1; q < 3; ++q) {
                least = at[q] < least ? at[q] : least;
                most = at[q] > most ? at[q] : most;
            }
    }
    return sum < least ? least : sum > most ? most : sum; /* no overshoot, which the search for the least would seek */
}

static double tried(const Grid *g, const float *later, double a, double b, double u) {
    double na, nb, cost;
    return model(a, b, u, &na, &nb, &cost) ? cost : cost + value(g, later, na, nb);
}

/* The least cost from (a, b) on, and the action that leads to it: the best of some, refined by parabolas. */
static double best(const Grid *g, const float *later, double a, double b, double *action) {
    const double h = 2 * g->limit / (g->actions - 1);
    double least = INFINITY, at = 0;
    for (int64_t k = 0; k < g->actions; ++k) {
        const double u = -g->limit + h * k, cost = tried(g, later, a, b, u);
        if (cost < least)
            least = cost, at = u;
    }
    for (double d = h; d > h / 20; d /= 4) {
        const double lower = fmax(at - d, -g->limit), upper = fmin(at + d, g->limit);
        const double cl = tried(g, later, a, b, lower), cu = tried(g, later, a, b, upper);
        double u = at;
        if (cl < least)
            least = cl, u = lower;
        if (cu < least)
            least = cu, u = upper;
        if (u == at && lower < at && at < upper) {
            const double bend = cl - 2 * least + cu;
            if (bend > 0) {
                u = at + 0.5 * d * (cl - cu) / bend;
                const double cost = tried(g, later, a, b, u);
                if (cost < least)
                    least = cost;
                else
                    u = at;
            }
        }
        at = u;
    }
    *action = at;
    return least;
}

/* values (steps + 1, nodes): the last are given, the others are filled in; where above `most`, they are this. */
void sweep(const Grid *g, int64_t steps, double most, float *values) {
    const int64_t n = g->nodes[0], m = g->nodes[1];
    for (int64_t k = steps - 1; k >= 0; --k) {
        const float *later = values + (k + 1) * n * m;
        float *now = values + k * n * m;
        for (int64_t i = 0; i < n; ++i)
            for (int64_t j = 0; j < m; ++j) {
                const double a = g->low[0] + (g->high[0] - g->low[0]) * i / (PERIODIC ? n : n - 1);
                const double b = g->low[1] + (g->high[1] - g->low[1]) * j / (m - 1);
                double action, least = best(g, later, a, b, &action);
                now[i * m + j] = (float)(least < most ? least : most);
            }
    }
}

/* Follows the values from a start; returns the true cost, or `most` where the episode did not end and `most` is finite. */
double follow(const Grid *g, int64_t steps, double most, const float *values, double a, double b, double *states, double *actions) {
    double total = 0;
    for (int64_t k = 0; k < steps; ++k) {
        double u, na, nb, cost;
        best(g, values + (k + 1) * g->nodes[0] * g->nodes[1], a, b, &u);
        const int ended = model(a, b, u, &na, &nb, &cost);
        total += cost;
        states[2 * k] = a, states[2 * k + 1] = b, actions[k] = u;
        a = na, b = nb;
        if (ended)
            return total;
    }
    return isfinite(most) ? most : total;
}

/* The value at a start. */
double at(const Grid *g, const float *values, double a, double b) { return value(g, values, a, b); }
