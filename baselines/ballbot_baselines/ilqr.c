/* iLQR with limits of the action, and with prices of the other inequalities, of many episodes.

   `ilqr.py` writes the functions `sweep`, `end`, `hold`, `bend` and `steer` above. A block of LANES episodes is computed at once. A lane
   that has finished takes up the next episode. So an episode's result does not depend on the others. */

#include <stdlib.h>
#include <string.h>

#define AHEAD (STATES * (STATES + 1) / 2 + STATES + 1) /* second derivatives, slopes, and what a step promises */
#define ROWS(name, count) real (*name)[count][LANES]
#define AT(rows) &(rows)[0][0], LANES
#define EACH_LANE for (int k = 0; k < LANES; ++k)

typedef struct {
    double width, tolerance, violation, bends, multiplier;
} options;

#define LEAST_WIDTH 2e-4 /* where widths end */
#define SHRINK 0.5       /* of widths, whenever the multipliers change */
#define FACTOR 10.0      /* by which a multiplier changes at most */
#define ITERATIONS 60    /* after which an episode is given up */

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

static void update(int count, const real *g, real *multiplier, real width, int k) {
    for (int i = 0; i < count; ++i) {
        const real t = g[i * LANES + k] / width, below = t < -0.5 ? t + 0.5 : 0;
        real by = 1 / (1 + (t - below)) - 4 * below;
        by = by > FACTOR ? FACTOR : by < 1 / FACTOR ? 1 / FACTOR : by;
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

/* Arrays of all episodes, C-contiguous: x (episodes, most+1, STATES) and a (episodes, most, 2) are guesses, and then results.
   `rows` are the episodes that are solved together. Those of fewer than n steps begin with steps of no length. */
typedef struct {
    int64_t most;
    const int64_t *rows;
    const int64_t *steps;
    const options *each;
    const double *lengths, *given;
    double *x_all, *a_all, *path_prices, *end_prices, *gains_all, *slopes_all, *costs;
    int64_t *status;
} problems;

/* LANES episodes: row t of the arrays is step t. */
typedef struct {
    int64_t n, active, job[LANES], tick[LANES];
    options o[LANES];
    ROWS(x, STATES); ROWS(x_new, STATES); ROWS(shift, STATES); ROWS(slope, STATES); ROWS(gain, 2 * STATES);
    ROWS(a, 2); ROWS(a_new, 2); ROWS(change, 2); ROWS(m, PATH + 1); ROWS(g, PATH + 1); ROWS(g_new, PATH + 1);
    ROWS(dt, 1); ROWS(rate, 1); ROWS(priced, 1);
    real e[END + 1][LANES], ge[END + 1][LANES], ge_new[END + 1][LANES], p[PARAMS + 1][LANES], ahead[2][AHEAD][LANES];
    real value[1][LANES], width[1][LANES], share[1][LANES], damping[1][LANES], open[1][LANES];
    real merit[LANES], merit_new[LANES], cost[LANES], cost_new[LANES], *promised;
} block;

/* An episode takes up lane k. */
static void load(block *b, const problems *q, int64_t next, int k) {
    const int64_t j = q->rows[next], empty = b->n - q->steps[j];
    b->job[k] = j;
    ++b->active, b->tick[k] = 0, b->merit[k] = INFINITY;
    b->o[k] = q->each[j], b->width[0][k] = b->o[k].width, b->share[0][k] = 1, b->damping[0][k] = 0;
    for (int64_t t = 0; t <= b->n; ++t) {
        const int64_t s = t < empty ? 0 : t - empty;
        for (int i = 0; i < STATES; ++i) b->x[t][i][k] = q->x_all[(j * (q->most + 1) + s) * STATES + i];
        if (t == b->n) break;
        b->dt[t][0][k] = t < empty ? 0 : q->lengths[j];
        for (int i = 0; i < 2; ++i) b->a[t][i][k] = t < empty ? 0 : q->a_all[(j * q->most + s) * 2 + i];
        for (int i = 0; i < PATH; ++i) b->m[t][i][k] = t < empty ? 0 : q->path_prices[(j * q->most + s) * PATH + i];
    }
    for (int i = 0; i < END; ++i) b->e[i][k] = q->end_prices[j * END + i];
    for (int i = 0; i < PARAMS; ++i) b->p[i][k] = q->given[j * PARAMS + i];
}

/* How far the constraints are missed, and complementarity is. */
static void off(const block *b, int k, real *gap, real *missed) {
    for (int64_t t = 0; t < b->n; ++t)
        if (b->dt[t][0][k] > 0) violation(PATH, &b->g[t][0][0], &b->m[t][0][0], k, gap, missed);
    violation(END, &b->ge[0][0], &b->e[0][0], k, gap, missed);
}

static void unload(block *b, const problems *q, int k, int over) {
    const int64_t j = b->job[k], empty = b->n - q->steps[j];
    for (int64_t t = empty; t <= b->n; ++t) {
        const int64_t s = t - empty;
        for (int i = 0; i < STATES; ++i) q->x_all[(j * (q->most + 1) + s) * STATES + i] = b->x[t][i][k];
        if (t == b->n) break;
        for (int i = 0; i < 2; ++i) q->a_all[(j * q->most + s) * 2 + i] = b->a[t][i][k];
        for (int i = 0; i < 2 * STATES; ++i) q->gains_all[(j * q->most + s) * 2 * STATES + i] = b->gain[t][i][k];
        for (int i = 0; i < STATES; ++i) q->slopes_all[(j * q->most + s) * STATES + i] = b->slope[t][i][k];
        for (int i = 0; i < PATH; ++i) q->path_prices[(j * q->most + s) * PATH + i] = b->m[t][i][k];
    }
    for (int i = 0; i < END; ++i) q->end_prices[j * END + i] = b->e[i][k];
    q->costs[j] = b->cost[k], q->status[j] = over;
    b->job[k] = -1, --b->active;
}

static void backwards(block *b) {
    end(AT(b->x[b->n]), AT(b->e), AT(b->p), AT(b->width), AT(b->ahead[b->n & 1]), AT(b->value), AT(b->ge_new));
    for (int64_t t = b->n - 1; t >= 0; --t)
        sweep(AT(b->ahead[(t + 1) & 1]), AT(b->x[t]), AT(b->a[t]), AT(b->dt[t]), AT(b->m[t]), AT(b->p), AT(b->width),
              AT(b->damping), AT(b->x[t + 1]), AT(b->open), AT(b->ahead[t & 1]), AT(b->change[t]), AT(b->gain[t]), AT(b->slope[t]));
    b->promised = b->ahead[0][AHEAD - 1];
    memcpy(b->x_new[0], b->x[0], sizeof *b->x_new);
#if STATES > 8
    EACH_LANE { /* the length of the steps is free */
        const real first = b->ahead[0][AHEAD - 2][k], second = b->ahead[0][AHEAD - STATES - 2][k], h = b->x[0][8][k];
        const real most = 0.15 * h, wanted = second > 0 ? -first / second : -first * INFINITY;
        real move = b->share[0][k] * (wanted > most ? most : wanted < -most ? -most : wanted);
        if (!(move == move)) move = 0;
        const real low = b->p[PARAMS - 2][k], high = b->p[PARAMS - 1][k];
        b->x_new[0][8][k] = h + move < low ? low : h + move > high ? high : h + move;
        b->promised[k] -= first * (b->x_new[0][8][k] - h) / 2;
    }
#endif
}

/* Bends guesses that are no motions: a Newton step on the dynamics. */
static void bend_guesses(block *b) {
    memset(b->shift[0], 0, sizeof *b->shift);
    EACH_LANE for (int i = 8; i < STATES; ++i) b->shift[0][i][k] = b->x_new[0][i][k] - b->x[0][i][k];
    for (int64_t t = 0; t < b->n; ++t)
        bend(AT(b->x[t]), AT(b->shift[t]), AT(b->x[t + 1]), AT(b->a[t]), AT(b->change[t]), AT(b->share), AT(b->gain[t]),
             AT(b->dt[t]), AT(b->p), AT(b->shift[t + 1]), AT(b->a_new[t]));
    EACH_LANE if (b->job[k] >= 0 && b->tick[k] < b->o[k].bends) {
        for (int64_t t = 0; t < b->n; ++t)
            for (int i = 0; i < 2; ++i) b->a[t][i][k] = b->a_new[t][i][k];
        for (int64_t t = 0; t <= b->n; ++t)
            for (int i = 0; i < STATES; ++i) b->x[t][i][k] += b->shift[t][i][k];
        ++b->tick[k];
    }
}

static void forwards(block *b) {
    EACH_LANE b->cost_new[k] = 0;
    for (int64_t t = 0; t < b->n; ++t)
        hold(AT(b->x_new[t]), AT(b->a[t]), AT(b->change[t]), AT(b->share), AT(b->gain[t]), AT(b->x[t]), AT(b->dt[t]),
             AT(b->p), AT(b->m[t]), AT(b->width), AT(b->x_new[t + 1]), AT(b->a_new[t]), AT(b->rate[t]), AT(b->g_new[t]), AT(b->priced[t]));
    end(AT(b->x_new[b->n]), AT(b->e), AT(b->p), AT(b->width), AT(b->ahead[1]), AT(b->value), AT(b->ge_new));
    for (int64_t t = 0; t < b->n; ++t) EACH_LANE b->cost_new[k] += b->rate[t][0][k];
    EACH_LANE {
        b->cost_new[k] += b->value[0][k];
        b->merit_new[k] = b->cost_new[k] + price(END, &b->ge_new[0][0], &b->e[0][0], b->width[0][k], k);
    }
    for (int64_t t = 0; t < b->n; ++t) EACH_LANE b->merit_new[k] += b->priced[t][0][k];
}

static void accept(block *b, int k) {
    for (int64_t t = 0; t <= b->n; ++t) {
        for (int i = 0; i < STATES; ++i) b->x[t][i][k] = b->x_new[t][i][k];
        if (t == b->n) break;
        for (int i = 0; i < 2; ++i) b->a[t][i][k] = b->a_new[t][i][k];
        for (int i = 0; i < PATH; ++i) b->g[t][i][k] = b->g_new[t][i][k];
    }
    for (int i = 0; i < END; ++i) b->ge[i][k] = b->ge_new[i][k];
    b->cost[k] = b->cost_new[k], b->merit[k] = b->merit_new[k];
}

/* New multipliers, and a narrower price. */
static void reprice(block *b, int k) {
    for (int64_t t = 0; t < b->n; ++t)
        if (b->dt[t][0][k] > 0) update(PATH, &b->g[t][0][0], &b->m[t][0][0], b->width[0][k], k);
    update(END, &b->ge[0][0], &b->e[0][0], b->width[0][k], k);
    b->width[0][k] = fmax(b->width[0][k] * SHRINK, LEAST_WIDTH);
    b->merit[k] = b->cost[k] + price(END, &b->ge[0][0], &b->e[0][0], b->width[0][k], k), b->share[0][k] = 1;
    for (int64_t t = 0; t < b->n; ++t)
        if (b->dt[t][0][k] > 0) b->merit[k] += price(PATH, &b->g[t][0][0], &b->m[t][0][0], b->width[0][k], k);
}

/* Takes or refuses the simulated step, and says how the episode ended, or -1. */
static int decide(block *b, int k) {
    const options *o = &b->o[k];
    const int tracked = b->tick[k] == o->bends;
    const int accepted = tracked ? isfinite(b->merit_new[k]) : b->merit_new[k] < b->merit[k];
    int over = -1;
    if (accepted)
        accept(b, k);
    else if (tracked)
        over = FELL;
    const real used = b->share[0][k], scale = fabs(b->cost[k]) + 1e-12;
    b->share[0][k] = accepted ? 1 : used * 0.35;
    real *damping = &b->damping[0][k];
    *damping = !accepted ? fmin(*damping * 4 + 1e-3, 1e3) : used < 1 ? *damping : *damping * 0.2;
    if (*damping < 1e-6) *damping = 0;
    const int settled = b->promised[k] < o->tolerance * scale;
    const int stuck = !accepted && b->share[0][k] < 1e-3;
    if (over < 0 && !tracked && (settled || stuck || (accepted && b->promised[k] < 1e-2 * scale))) {
        real gap = 0, missed = 0;
        off(b, k, &gap, &missed);
        if ((settled || stuck) && missed <= o->violation && gap <= 10 * o->tolerance * scale)
            over = settled ? OPTIMAL : STUCK;
        else if (stuck && b->width[0][k] <= LEAST_WIDTH)
            over = STUCK;
        else
            reprice(b, k);
    }
    return ++b->tick[k] >= ITERATIONS && over < 0 ? EXHAUSTED : over;
}

/* Solves `jobs` of the episodes, of at most n steps, each with its options. */
void solve(int64_t jobs, int64_t n, int64_t most, const int64_t *rows, const options *each, const int64_t *steps,
           const double *lengths, const double *given, double *x, double *a, double *path_prices, double *end_prices,
           double *gains, double *slopes, double *costs, int64_t *status) {
    const problems q = {most, rows, steps, each, lengths, given, x, a, path_prices, end_prices, gains, slopes, costs, status};
    block *b = calloc(1, sizeof *b);
    b->n = n;
#define MAKE(name) b->name = calloc((size_t)n + 1, sizeof *b->name)
    MAKE(x); MAKE(x_new); MAKE(shift); MAKE(slope); MAKE(gain); MAKE(a); MAKE(a_new); MAKE(change); MAKE(m); MAKE(g);
    MAKE(g_new); MAKE(dt); MAKE(rate); MAKE(priced);
    int64_t next = 0;
    EACH_LANE b->job[k] = -1, b->width[0][k] = 1;
    for (;;) {
        int bending = 0, simulating = 0, bends[LANES];
        EACH_LANE {
            if (b->job[k] < 0 && next < jobs) load(b, &q, next++, k);
            bends[k] = b->job[k] >= 0 && b->tick[k] < b->o[k].bends;
            b->open[0][k] = b->tick[k] <= b->o[k].bends;
            if (b->job[k] >= 0) *(bends[k] ? &bending : &simulating) = 1;
        }
        if (!b->active) break;
        backwards(b);
        if (bending) bend_guesses(b);
        if (!simulating) continue;
        forwards(b);
        EACH_LANE if (b->job[k] >= 0 && !bends[k]) {
            const int over = decide(b, k);
            if (over >= 0) unload(b, &q, k, over);
        }
    }
    void *made[] = {b->x, b->x_new, b->shift, b->slope, b->gain, b->a, b->a_new, b->change, b->m, b->g, b->g_new, b->dt,
                    b->rate, b->priced, b};
    for (unsigned i = 0; i < sizeof made / sizeof *made; ++i) free(made[i]);
}

/* Simulates the cascade along paths (jobs, n, 4) with its two settings, or the actions a where there is no path, with feedback
   where there is one: gains (jobs, 2, STATES), each with the state about which it is. x (jobs, n+1, STATES) has the initial states. */
void follow(int64_t jobs, int64_t n, const double *lengths, const double *given, const double *path_all,
            const double *settings, const double *feedback, double *x_all, double *a_all, double *costs, double *missed_all) {
    for (int64_t first = 0; first < jobs; first += LANES) {
        real x[2][STATES][LANES], a[2][LANES], path[4][LANES], p[PARAMS + 1][LANES], set[2][LANES], rate[1][LANES];
        real dt[1][LANES], g[PATH + 1][LANES], cost[LANES] = {0}, missed[LANES] = {0}, zero[PATH + 3][LANES] = {{0}};
        real lqr[3 * STATES][LANES] = {{0}};
        real one[1][LANES], priced[1][LANES], taken[2][LANES];
        int64_t job[LANES];
        EACH_LANE {
            const int64_t j = job[k] = first + k < jobs ? first + k : first;
            one[0][k] = 1, dt[0][k] = lengths[j], set[0][k] = settings[2 * j], set[1][k] = settings[2 * j + 1];
            for (int i = 0; i < STATES; ++i) x[0][i][k] = x_all[j * (n + 1) * STATES + i];
            for (int i = 0; i < PARAMS; ++i) p[i][k] = given[j * PARAMS + i];
            if (feedback)
                for (int i = 0; i < 3 * STATES; ++i) lqr[i][k] = feedback[j * 3 * STATES + i];
        }
        for (int64_t t = 0; t < n; ++t) {
            real *now = &x[t & 1][0][0], *after = &x[(t + 1) & 1][0][0];
            if (path_all) {
                EACH_LANE for (int i = 0; i < 4; ++i) path[i][k] = path_all[(job[k] * n + t) * 4 + i];
                steer(now, LANES, AT(path), AT(set), AT(p), AT(a));
            } else
                EACH_LANE for (int i = 0; i < 2; ++i) a[i][k] = a_all[(job[k] * n + t) * 2 + i];
            hold(now, LANES, AT(a), AT(zero), AT(zero), AT(lqr), &lqr[2 * STATES][0], LANES, AT(dt), AT(p), AT(zero), AT(one),
                 after, LANES, AT(taken), AT(rate), AT(g), AT(priced));
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
