/* iLQR with limits of the action, and with the other inequalities by augmented Lagrangians, of many episodes.

   `ilqr.py` writes the functions above of this file: `sweep`, `hold` and `end`. A block of LANES episodes is computed at once. A lane
   that has finished takes up the next episode. So an episode's result does not depend on the others. */

#include <stdlib.h>
#include <string.h>

#define AHEAD (STATES * (STATES + 1) / 2 + STATES + 1) /* second derivatives, slopes, and what a step promises */
#define ROWS(name, count) real (*name)[count][LANES]
#define MAKE(name, steps, count) ROWS(name, count) = calloc((size_t)(steps) + 1, sizeof *name)
#define AT(rows) &(rows)[0][0], LANES
#define EACH_LANE for (int k = 0; k < LANES; ++k)

typedef struct {
    double width, least_width, shrink, factor, tolerance, violation, iterations, bends;
} options;

enum { OPTIMAL = 0, STUCK = 1, EXHAUSTED = 2, FELL = 3 };

/* A constraint g >= 0 costs m w f(g / w), with its multiplier m, a width w, f(t) = -log(1 + t) for t > -1/2, and the parabola with
   the same slope and curvature there for less (Ben-Tal and Zibulevsky, "Penalty/barrier multiplier methods", 1997). */
static real price(int count, const real *g, const real *multiplier, real width, int k) {
    real sum = 0;
    for (int i = 0; i < count; ++i) {
        const real t = g[i * LANES + k] / width, below = t < -0.5 ? t + 0.5 : 0;
        sum += multiplier[i * LANES + k] * width * (-2 * below + 2 * below * below - log(1 + (t - below)));
    }
    return sum;
}

static void update(int count, const real *g, real *multiplier, real width, real factor, int k) {
    for (int i = 0; i < count; ++i) {
        const real t = g[i * LANES + k] / width, below = t < -0.5 ? t + 0.5 : 0;
        real by = 1 / (1 + (t - below)) - 4 * below;
        by = by > factor ? factor : by < 1 / factor ? 1 / factor : by;
        multiplier[i * LANES + k] *= by;
    }
}

static void violation(int count, const real *g, const real *multiplier, int k, real *gap, real *missed) {
    for (int i = 0; i < count; ++i) {
        const real room = g[i * LANES + k];
        *gap += fabs(multiplier[i * LANES + k] * room);
        if (!(-room <= *missed)) *missed = -room;
    }
}

/* Solves `jobs` episodes of at most n steps; those with fewer begin with steps of no length. Arrays are C-contiguous; x (jobs,
   n+1, STATES) and a (jobs, n, 2) are guesses, and then results; m (jobs, n, PATH) and e (jobs, END) multipliers, both ways.
   The first steps bend a guess that is no motion toward one by Newton steps on the dynamics; then all are simulated. */
void solve(int64_t jobs, int64_t n, const options *o, const int64_t *steps, const double *lengths,
           const double *given, double *x_all, double *a_all, double *m_all, double *e_all, double *gains_all,
           double *slopes_all, double *costs, double *missed_all, int64_t *status, int64_t *iterations) {
    MAKE(x, n, STATES); MAKE(a, n, 2); MAKE(m, n, PATH + 1); MAKE(dt, n, 1);
    MAKE(x_new, n, STATES); MAKE(a_new, n, 2); MAKE(g, n, PATH + 1); MAKE(g_new, n, PATH + 1); MAKE(rate, n, 1); MAKE(priced, n, 1);
    MAKE(change, n, 2); MAKE(gain, n, 2 * STATES); MAKE(slope, n, STATES); MAKE(shift, n, STATES);
    real e[END + 1][LANES] = {{0}}, ge[END + 1][LANES] = {{0}}, ge_new[END + 1][LANES] = {{0}};
    real p[PARAMS + 1][LANES] = {{0}}, ahead[2][AHEAD][LANES], value[1][LANES], width[1][LANES], share[1][LANES];
    real damping[1][LANES] = {{0}}, open[1][LANES], merit[LANES], cost[LANES] = {0};
    int64_t job[LANES], tick[LANES] = {0}, next = 0, active = 0;
    EACH_LANE job[k] = -1, width[0][k] = 1, share[0][k] = 0;

    for (;;) {
        EACH_LANE if (job[k] < 0 && next < jobs) { /* takes up the next episode */
            const int64_t j = job[k] = next++, empty = n - steps[j];
            ++active, tick[k] = 0, merit[k] = INFINITY;
            width[0][k] = o->width, share[0][k] = 1, damping[0][k] = 0;
            for (int64_t t = 0; t <= n; ++t) {
                const int64_t s = t < empty ? 0 : t - empty;
                for (int i = 0; i < STATES; ++i) x[t][i][k] = x_all[(j * (n + 1) + s) * STATES + i];
                if (t == n) break;
                dt[t][0][k] = t < empty ? 0 : lengths[j];
                for (int i = 0; i < 2; ++i) a[t][i][k] = t < empty ? 0 : a_all[(j * n + s) * 2 + i];
                for (int i = 0; i < PATH; ++i) m[t][i][k] = t < empty ? 0 : m_all[(j * n + s) * PATH + i];
            }
            for (int i = 0; i < END; ++i) e[i][k] = e_all[j * END + i];
            for (int i = 0; i < PARAMS; ++i) p[i][k] = given[j * PARAMS + i];
        }
        if (!active) break;

        /* backwards */
        int bending = 0, simulating = 0, bent[LANES] = {0};
        EACH_LANE {
            open[0][k] = tick[k] <= o->bends;
            if (job[k] >= 0) *(tick[k] < o->bends ? &bending : &simulating) = 1;
        }
        end(AT(x[n]), AT(e), AT(p), AT(width), AT(ahead[n & 1]), AT(value), AT(ge_new));
        for (int64_t t = n - 1; t >= 0; --t)
            sweep(AT(ahead[(t + 1) & 1]), AT(x[t]), AT(a[t]), AT(dt[t]), AT(m[t]), AT(p), AT(width), AT(damping),
                  AT(x[t + 1]), AT(open), AT(ahead[t & 1]), AT(change[t]), AT(gain[t]), AT(slope[t]));
        real *promised = ahead[0][AHEAD - 1];

        /* forwards */
        memcpy(x_new[0], x[0], sizeof *x_new);
#if STATES > 8
        EACH_LANE { /* the length of the steps is free */
            const real first = ahead[0][AHEAD - 2][k], second = ahead[0][AHEAD - STATES - 2][k], h = x[0][8][k];
            const real most = 0.15 * h, wanted = second > 0 ? -first / second : -first * INFINITY;
            real move = share[0][k] * (wanted > most ? most : wanted < -most ? -most : wanted);
            if (!(move == move)) move = 0;
            const real low = p[PARAMS - 2][k], high = p[PARAMS - 1][k];
            x_new[0][8][k] = h + move < low ? low : h + move > high ? high : h + move;
            promised[k] -= first * (x_new[0][8][k] - h) / 2;
        }
#endif
        real cost_new[LANES] = {0}, merit_new[LANES];
        if (bending) {
            memset(shift[0], 0, sizeof *shift);
            EACH_LANE for (int i = 8; i < STATES; ++i) shift[0][i][k] = x_new[0][i][k] - x[0][i][k];
            for (int64_t t = 0; t < n; ++t)
                bend(AT(x[t]), AT(shift[t]), AT(x[t + 1]), AT(a[t]), AT(change[t]), AT(share), AT(gain[t]), AT(dt[t]), AT(p),
                     AT(shift[t + 1]), AT(a_new[t]));
            EACH_LANE if (job[k] >= 0 && tick[k] < o->bends) {
                for (int64_t t = 0; t < n; ++t)
                    for (int i = 0; i < 2; ++i) a[t][i][k] = a_new[t][i][k];
                for (int64_t t = 0; t <= n; ++t)
                    for (int i = 0; i < STATES; ++i) x[t][i][k] += shift[t][i][k];
                ++tick[k], bent[k] = 1;
            }
            if (!simulating) continue;
        }
        for (int64_t t = 0; t < n; ++t)
            hold(AT(x_new[t]), AT(a[t]), AT(change[t]), AT(share), AT(gain[t]), AT(x[t]), AT(dt[t]), AT(p), AT(m[t]),
                 AT(width), AT(x_new[t + 1]), AT(a_new[t]), AT(rate[t]), AT(g_new[t]), AT(priced[t]));
        end(AT(x_new[n]), AT(e), AT(p), AT(width), AT(ahead[1]), AT(value), AT(ge_new));
        for (int64_t t = 0; t < n; ++t) EACH_LANE cost_new[k] += rate[t][0][k];
        EACH_LANE {
            cost_new[k] += value[0][k];
            merit_new[k] = cost_new[k] + price(END, &ge_new[0][0], &e[0][0], width[0][k], k);
        }
        for (int64_t t = 0; t < n; ++t) EACH_LANE merit_new[k] += priced[t][0][k];

        /* decides for each episode */
        EACH_LANE if (job[k] >= 0 && !bent[k]) {
            const int64_t j = job[k];
            const int tracked = tick[k] == o->bends, accepted = tracked ? isfinite(merit_new[k]) : merit_new[k] < merit[k];
            int over = -1;
            if (accepted) {
                for (int64_t t = 0; t <= n; ++t) {
                    for (int i = 0; i < STATES; ++i) x[t][i][k] = x_new[t][i][k];
                    if (t == n) break;
                    for (int i = 0; i < 2; ++i) a[t][i][k] = a_new[t][i][k];
                    for (int i = 0; i < PATH; ++i) g[t][i][k] = g_new[t][i][k];
                }
                for (int i = 0; i < END; ++i) ge[i][k] = ge_new[i][k];
                cost[k] = cost_new[k], merit[k] = merit_new[k];
            } else if (tracked)
                over = FELL;
            const real used = share[0][k], scale = fabs(cost[k]) + 1e-12;
            share[0][k] = accepted ? 1 : used * 0.35;
            damping[0][k] = accepted ? (used < 1 ? damping[0][k] : damping[0][k] * 0.2) : fmin(damping[0][k] * 4 + 1e-3, 1e3);
            if (damping[0][k] < 1e-6) damping[0][k] = 0;
            const int settled = promised[k] < o->tolerance * scale;
            const int stuck = !accepted && share[0][k] < 1e-3;
            if (over < 0 && !tracked && (settled || stuck || (accepted && promised[k] < 1e-2 * scale))) {
                real gap = 0, missed = 0;
                for (int64_t t = 0; t < n; ++t)
                    if (dt[t][0][k] > 0) violation(PATH, &g[t][0][0], &m[t][0][0], k, &gap, &missed);
                violation(END, &ge[0][0], &e[0][0], k, &gap, &missed);
                if ((settled || stuck) && missed <= o->violation && gap <= 10 * o->tolerance * scale)
                    over = settled ? OPTIMAL : STUCK;
                else if (stuck && width[0][k] <= o->least_width)
                    over = STUCK;
                else {
                    for (int64_t t = 0; t < n; ++t)
                        if (dt[t][0][k] > 0) update(PATH, &g[t][0][0], &m[t][0][0], width[0][k], o->factor, k);
                    update(END, &ge[0][0], &e[0][0], width[0][k], o->factor, k);
                    width[0][k] = fmax(width[0][k] * o->shrink, o->least_width);
                    merit[k] = cost[k] + price(END, &ge[0][0], &e[0][0], width[0][k], k), share[0][k] = 1;
                    for (int64_t t = 0; t < n; ++t)
                        if (dt[t][0][k] > 0) merit[k] += price(PATH, &g[t][0][0], &m[t][0][0], width[0][k], k);
                }
            }
            if (++tick[k] >= o->iterations && over < 0) over = EXHAUSTED;
            if (over < 0) continue;
            /* finished */
            const int64_t empty = n - steps[j];
            real gap = 0, missed = 0;
            for (int64_t t = empty; t <= n; ++t) {
                const int64_t s = t - empty;
                for (int i = 0; i < STATES; ++i) x_all[(j * (n + 1) + s) * STATES + i] = x[t][i][k];
                if (t == n) break;
                for (int i = 0; i < 2; ++i) a_all[(j * n + s) * 2 + i] = a[t][i][k];
                for (int i = 0; i < PATH; ++i) m_all[(j * n + s) * PATH + i] = m[t][i][k];
                for (int i = 0; i < 2 * STATES; ++i) gains_all[(j * n + s) * 2 * STATES + i] = gain[t][i][k];
                for (int i = 0; i < STATES; ++i) slopes_all[(j * n + s) * STATES + i] = slope[t][i][k];
                violation(PATH, &g[t][0][0], &m[t][0][0], k, &gap, &missed);
            }
            violation(END, &ge[0][0], &e[0][0], k, &gap, &missed);
            for (int i = 0; i < END; ++i) e_all[j * END + i] = e[i][k];
            costs[j] = cost[k], missed_all[j] = missed, status[j] = over, iterations[j] = tick[k];
            job[k] = -1, --active;
        }
    }
    void *made[] = {x, a, m, dt, x_new, a_new, g, g_new, rate, change, gain, slope, shift, priced};
    for (unsigned i = 0; i < sizeof made / sizeof *made; ++i) free(made[i]);
}

/* Simulates the cascade along paths (jobs, n, 8) with its two settings, or the actions a where there is no path.
   x (jobs, n+1, STATES) has the initial states. */
void follow(int64_t jobs, int64_t n, const double *lengths, const double *given, const double *path_all,
            const double *settings, double *x_all, double *a_all, double *costs, double *missed_all) {
    for (int64_t first = 0; first < jobs; first += LANES) {
        real x[2][STATES][LANES], a[2][LANES], path[8][LANES], p[PARAMS + 1][LANES], set[2][LANES], rate[1][LANES];
        real dt[1][LANES], g[PATH + 1][LANES], cost[LANES] = {0}, missed[LANES] = {0}, zero[2 * STATES + PATH + 1][LANES] = {{0}};
        real one[1][LANES], priced[1][LANES], taken[2][LANES];
        int64_t job[LANES];
        EACH_LANE {
            const int64_t j = job[k] = first + k < jobs ? first + k : first;
            one[0][k] = 1, dt[0][k] = lengths[j], set[0][k] = settings[2 * j], set[1][k] = settings[2 * j + 1];
            for (int i = 0; i < STATES; ++i) x[0][i][k] = x_all[j * (n + 1) * STATES + i];
            for (int i = 0; i < PARAMS; ++i) p[i][k] = given[j * PARAMS + i];
        }
        for (int64_t t = 0; t < n; ++t) {
            real *now = &x[t & 1][0][0], *after = &x[(t + 1) & 1][0][0];
            if (path_all) {
                EACH_LANE for (int i = 0; i < 8; ++i) path[i][k] = path_all[(job[k] * n + t) * 8 + i];
                steer(now, LANES, AT(path), AT(set), AT(p), AT(a));
            } else
                EACH_LANE for (int i = 0; i < 2; ++i) a[i][k] = a_all[(job[k] * n + t) * 2 + i];
            hold(now, LANES, AT(a), AT(zero), AT(zero), AT(zero), now, LANES, AT(dt), AT(p), AT(zero), AT(one), after, LANES,
                 AT(taken), AT(rate), AT(g), AT(priced));
            EACH_LANE {
                const int64_t j = job[k];
                cost[k] += rate[0][k];
                for (int i = 0; i < PATH; ++i)
                    if (!(-g[i][k] <= missed[k])) missed[k] = -g[i][k];
                for (int i = 0; i < STATES; ++i) x_all[(j * (n + 1) + t + 1) * STATES + i] = after[i * LANES + k];
                for (int i = 0; i < 2; ++i) a_all[(j * n + t) * 2 + i] = taken[i][k];
            }
        }
        EACH_LANE costs[job[k]] = cost[k], missed_all[job[k]] = missed[k];
    }
}
