/* Dynamic programming over a grid of states (a, b), backwards in time: the check of optima that owes nothing to their search.

   What precedes this file chooses PENDULUM or the mountain car; their steps are Gymnasium's, written again. Tables hold the least
   cost of what follows the cost of a state alone, which has the pendulum's kink and is exact. The first axis of a grid is an angle:
   the pendulum's, or the phase of the car in the valley. The second is the pendulum's rate, or the car's amplitude: the root of
   its energy, half a step later, which stays nearly what it is while no force acts. */

#include <math.h>
#include <stdint.h>

typedef struct { double low[2], high[2]; int64_t nodes[2], actions; double most; } Grid;

#if PENDULUM
#define LIMIT 2.0
#define PRICE 0.001
#define NOISE 1e-7 /* squared second differences of rounded tables */
static double own(double a, double b) {
    const double turn = 6.283185307179586, angle = a - turn * floor((a + turn / 2) / turn);
    return angle * angle + 0.1 * b * b;
}
static void chart(double a, double b, double *s, double *r) { *s = a, *r = b; }
static void unchart(double s, double r, double *a, double *b) { *a = s, *b = r; }
static int moved(double a, double b, double u, double *na, double *nb) {
    *nb = fmax(-8.0, fmin(8.0, b + (15.0 * sin(a) + 3.0 * u) * 0.05));
    *na = a + *nb * 0.05;
    return 0;
}
#else
#define LIMIT 1.0
#define PRICE 0.1
#define NOISE 1e-13
#define DEEP 0.05773502691896258 /* 2 sqrt(gravity / 3): the root of twice the height of the hills */
#define EIGHTH 0.7853981633974483
#define ENOUGH 0.05738 /* the amplitude that reaches the goal: nodes crowd there, because from there on nothing costs */
static double own(double a, double b) { return 0; }
static void chart(double a, double b, double *s, double *r) {
    const double q = DEEP * sin(1.5 * a + EIGHTH), v = b - 0.00125 * cos(3 * a);
    const double less = 1 - sqrt(q * q + v * v) / ENOUGH;
    *s = atan2(v, q), *r = 1 - copysign(sqrt(fabs(less)), less);
}
static void unchart(double s, double r, double *a, double *b) {
    const double amplitude = ENOUGH * (1 - (1 - r) * fabs(1 - r));
    *a = (asin(fmax(-1.0, fmin(1.0, amplitude * cos(s) / DEEP))) - EIGHTH) / 1.5;
    *b = amplitude * sin(s) + 0.00125 * cos(3 * *a);
}
/* States beyond the wall, which are nodes alone, continue what is in front of it: there, too, the wall stops what moves left. */
static int moved(double a, double b, double u, double *na, double *nb) {
    *nb = fmax(-0.07, fmin(0.07, b + 0.0015 * u - 0.0025 * cos(3 * a)));
    *na = fmin(0.6, a + *nb);
    if (*na <= -1.2 && *nb < 0)
        *na = fmin(a, -1.2), *nb = 0;
    return *na >= 0.45 && *nb >= 0;
}
#endif

/* Between the second and the third of four values: a mean of the parabolas through the first and the last three of them. In smooth
   regions it is the cubic; next to a kink it is the parabola that does not cross it, so that no ripple pretends a lower cost. */
static double between(double f0, double f1, double f2, double f3, double t) {
    const double left = f0 - 2 * f1 + f2, right = f1 - 2 * f2 + f3;
    const double sl = NOISE + left * left, sr = NOISE + right * right;
    const double wl = t > 1 ? 0 : (2 - t) * sr * sr, wr = t < 0 ? 0 : (1 + t) * sl * sl; /* beyond, from the edge's side */
    return f1 + t * (f2 - f1) + 0.5 * t * (t - 1) * (wl * left + wr * right) / (wl + wr);
}

static double interpolated(const Grid *g, const float *v, double a, double b) {
    const int64_t n = g->nodes[0], m = g->nodes[1];
    double s, r;
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
    const int arrived = moved(a, b, u, &na, &nb);
    return PRICE * u * u + (arrived ? 0 : own(na, nb) + interpolated(g, later, na, nb));
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

/* The table (nodes) of a control step from that of the next. */
void sweep(const Grid *g, const float *later, float *now) {
    const int64_t n = g->nodes[0], m = g->nodes[1], half = PENDULUM ? n / 2 : n - 1;
    for (int64_t i = 0; i <= half; ++i)
        for (int64_t j = 0; j < m; ++j) {
            double a, b, action;
            unchart(g->low[0] + (g->high[0] - g->low[0]) * i / n, g->low[1] + (g->high[1] - g->low[1]) * j / (m - 1), &a, &b);
            const double least = !PENDULUM && a >= 0.45 ? 0 : best(g, later, a, b, &action);
            now[i * m + j] = (float)(least < g->most ? least : g->most);
        }
    if (PENDULUM) /* (-a, -b) costs the same; rows 0 and n / 2 are their own mirror images */
        for (int64_t i = n / 2 + 1; i < n; ++i)
            for (int64_t j = 0; j < m; ++j)
                now[i * m + j] = now[(n - i) * m + m - 1 - j];
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
        ended[k] = (uint8_t)moved(x[0], x[1], actions[k], &na, &nb);
        x[0] = na, x[1] = nb;
    }
}
