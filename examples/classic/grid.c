/* Dynamic programming over a grid of states (a, b), backwards in time: the check of optima that owes nothing to their search.

   A file of the system precedes this one, with Gymnasium's step written again. It defines

       LIMIT, PRICE    the largest action, and what its square costs
       NOISE           of squared second differences of rounded tables
       CLIFF           second differences from which values jump, and the straight line between two of them is all that is known
       MIRRORED        whether (-a, -b) costs the same
       own             cost of a state alone, which the tables leave out, because its kink is exact
       chart, unchart  coordinates of a grid: the first is an angle, which wraps
       drift           how nodes move from step to step
       moved           a control step; whether it ends the episode (ARRIVED) or at the system's stop (STOPPED)
       stop            the state there
       direct          the least cost of ending soon, or `most` where that is not known

   A table has a number for each node, and the value of the stop behind them. */

#include <math.h>
#include <stdint.h>

typedef struct {
    double low[2], high[2];  /* of the coordinates; the first is open at its end */
    int64_t nodes[2], actions;
    int64_t age;             /* steps for which the nodes of the next table have moved */
    int64_t left;            /* control steps that are left from there */
    double most;             /* above every value that matters */
} Grid;

/* Between the second and the third of four values: a mean of the parabolas through the first and the last three of them. In smooth
   regions it is the cubic; next to a kink it is the parabola that does not cross it, so that no ripple pretends a lower cost. */
static double between(double f0, double f1, double f2, double f3, double t) {
    const double left = f0 - 2 * f1 + f2, right = f1 - 2 * f2 + f3;
    const double sl = NOISE + left * left, sr = NOISE + right * right;
    const double wl = t > 1 ? 0 : (2 - t) * sr * sr, wr = t < 0 ? 0 : (1 + t) * sl * sl; /* beyond, from the edge's side */
    const double value = f1 + t * (f2 - f1) + 0.5 * t * (t - 1) * (wl * left + wr * right) / (wl + wr);
    return fabs(left) + fabs(right) < CLIFF ? value : fmax(fmin(f1, f2), fmin(fmax(f1, f2), value));
}

static double interpolated(const Grid *g, const float *v, double a, double b) {
    const int64_t n = g->nodes[0], m = g->nodes[1];
    double s, r;
    drift(&a, &b, -g->age);
    chart(a, b, &s, &r);
    s = (s - g->low[0]) / (g->high[0] - g->low[0]) * n;
    r = fmin(m - 1, (r - g->low[1]) / (g->high[1] - g->low[1]) * (m - 1));
    int64_t i = (int64_t)floor(s), j = (int64_t)floor(r);
    j = j < 1 ? 1 : j > m - 3 ? m - 3 : j;
    double row[4];
    for (int p = 0; p < 4; ++p) {
        const float *at = v + ((i + p - 1) % n + n) % n * m + j - 1;
        row[p] = between(at[0], at[1], at[2], at[3], r - j);
    }
    return between(row[0], row[1], row[2], row[3], s - i);
}

static double tried(const Grid *g, const float *later, double a, double b, double u) {
    double na, nb;
    const int end = moved(a, b, u, &na, &nb);
    const double price = PRICE * u * u;
    if (end)
        return price + (end == STOPPED ? later[g->nodes[0] * g->nodes[1]] : 0);
    const double soon = direct(na, nb, g->left, g->most);
    return price + own(na, nb) + (soon < g->most ? soon : interpolated(g, later, na, nb));
}

/* The least cost from (a, b) on, without that of the state itself, and the action that leads to it: the best of some, refined by
   parabolas. */
static double best(const Grid *g, const float *later, double a, double b, double *action) {
    const double h = 2 * LIMIT / (g->actions - 1);
    double least = INFINITY, at = 0;
    for (int64_t k = 0; k < g->actions; ++k) {
        const double u = -LIMIT + h * k, cost = tried(g, later, a, b, u);
        if (cost < least)
            least = cost, at = u;
    }
    for (double d = h; d > h / 20; d /= 4) {
        const double lower = fmax(at - d, -LIMIT), upper = fmin(at + d, LIMIT);
        const double cl = tried(g, later, a, b, lower), cu = tried(g, later, a, b, upper);
        const double middle = at, bend = cl - 2 * least + cu;
        if (cl < least)
            least = cl, at = lower;
        if (cu < least)
            least = cu, at = upper;
        if (bend > 0) {
            const double u = fmax(-LIMIT, fmin(LIMIT, middle + 0.5 * d * (cl - cu) / bend));
            const double cost = tried(g, later, a, b, u);
            if (cost < least)
                least = cost, at = u;
        }
    }
    *action = at;
    return least;
}

/* The table of a control step from that of the next; `age` is that of its own nodes. */
void sweep(const Grid *g, const float *later, int64_t age, float *now) {
    const int64_t n = g->nodes[0], m = g->nodes[1], half = MIRRORED ? n / 2 : n - 1;
    double a, b, action;
    for (int64_t i = 0; i <= half; ++i)
        for (int64_t j = 0; j < m; ++j) {
            unchart(g->low[0] + (g->high[0] - g->low[0]) * i / n, g->low[1] + (g->high[1] - g->low[1]) * j / (m - 1), &a, &b);
            drift(&a, &b, age);
            now[i * m + j] = (float)fmin(g->most, best(g, later, a, b, &action));
        }
    if (MIRRORED) /* rows 0 and n / 2 are their own mirror images */
        for (int64_t i = n / 2 + 1; i < n; ++i)
            for (int64_t j = 0; j < m; ++j)
                now[i * m + j] = now[(n - i) * m + m - 1 - j];
    stop(&a, &b);
    now[n * m] = (float)fmin(g->most, best(g, later, a, b, &action));
}

/* What states (count, 2) cost from this step on by the table of the next. They move by the actions that lead to it; costs (count)
   grows by what the steps cost. Episodes that have ended stay where they are. */
void follow(const Grid *g, const float *later, int64_t count, double *states, double *actions, double *costs, double *values,
            uint8_t *ended) {
    for (int64_t k = 0; k < count; ++k) {
        double *x = states + 2 * k, na, nb;
        actions[k] = values[k] = 0;
        if (ended[k])
            continue;
        values[k] = own(x[0], x[1]) + best(g, later, x[0], x[1], actions + k);
        costs[k] += own(x[0], x[1]) + PRICE * actions[k] * actions[k];
        const int end = moved(x[0], x[1], actions[k], &na, &nb);
        if (end == STOPPED)
            stop(&na, &nb);
        ended[k] = end == ARRIVED;
        x[0] = na, x[1] = nb;
    }
}
