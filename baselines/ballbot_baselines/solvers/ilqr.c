/* iLQR with limits of the action, and with prices of the other inequalities, of many episodes.

   `ilqr.py` writes the functions `sweep`, `end`, `hold`, `bend` and `steer` above. A block of LANES episodes is computed at once. A lane
   that has finished takes up the next episode. So an episode's result does not depend on the others. */

#include <stdlib.h>
#include <string.h>

#define AHEAD (STATES * (STATES + 1) / 2 + STATES + 1) /* second derivatives, slopes, and what a step promises */
#define AT(rows) &(rows)[0][0], LANES
#define EACH_LANE for (int k = 0; k < LANES; ++k)
#define EACH_STEP for (step *s = b->first; s < b->s + b->n; ++s)

typedef struct {
    double width, tolerance, violation, bends, multiplier;
} options;

#define LEAST_WIDTH 2e-4 /* where widths end */
#define SHRINK 0.5       /* of widths, whenever the multipliers change */
#define FACTOR 10.0      /* by which a multiplier changes at most */
#define ITERATIONS 60    /* after which an episode is given up */

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

/* Arrays of all episodes, C-contiguous: x (episodes, n+1, STATES) and a (episodes, n, 2) are guesses, and then results.
   Episodes of fewer than n steps begin with steps of no length. */
typedef struct {
    double length;
    const int64_t *steps;
    const options *each;
    const double *given;
    double *x_all, *a_all, *path_prices, *end_prices, *gains_all, *slopes_all, *costs;
    int64_t *solved;
} problems;

/* One control step of LANES episodes. */
typedef struct {
    real x[STATES][LANES], x_new[STATES][LANES], shift[STATES][LANES], slope[STATES][LANES], gain[2 * STATES][LANES];
    real a[2][LANES], a_new[2][LANES], change[2][LANES], dt[1][LANES], rate[1][LANES], priced[1][LANES];
    real m[PATH + 1][LANES], g[PATH + 1][LANES], g_new[PATH + 1][LANES];
} step;

/* LANES episodes. All their steps before `first` have no length. */
typedef struct {
    int64_t n, active, job[LANES], tick[LANES], empty[LANES];
    step *first;
    options o[LANES];
    real e[END + 1][LANES], ge[END + 1][LANES], ge_new[END + 1][LANES], p[PARAMS + 1][LANES], ahead[2][AHEAD][LANES];
    real value[1][LANES], width[1][LANES], share[1][LANES], damping[1][LANES], open[1][LANES];
    real merit[LANES], merit_new[LANES], cost[LANES], cost_new[LANES], promised[LANES];
    step s[]; /* n+1 */
} block;

/* An episode takes up lane k. */
static void load(block *b, const problems *q, int64_t j, int k) {
    const int64_t n = b->n, empty = n - q->steps[j];
    b->job[k] = j, b->empty[k] = empty;
    ++b->active, b->tick[k] = 0, b->merit[k] = INFINITY;
    b->o[k] = q->each[j], b->width[0][k] = b->o[k].width, b->share[0][k] = 1, b->damping[0][k] = 0;
    for (int64_t t = 0; t <= n; ++t) {
        step *s = &b->s[t];
        const int64_t row = t < empty ? 0 : t - empty;
        for (int i = 0; i < STATES; ++i) s->x[i][k] = q->x_all[(j * (n + 1) + row) * STATES + i];
        if (t == n) break;
        s->dt[0][k] = t < empty ? 0 : q->length;
        for (int i = 0; i < 2; ++i) s->a[i][k] = t < empty ? 0 : q->a_all[(j * n + row) * 2 + i];
        for (int i = 0; i < PATH; ++i) s->m[i][k] = t < empty ? 0 : q->path_prices[(j * n + row) * PATH + i];
    }
    for (int i = 0; i < END; ++i) b->e[i][k] = q->end_prices[j * END + i];
    for (int i = 0; i < PARAMS; ++i) b->p[i][k] = q->given[j * PARAMS + i];
}

/* How far the constraints are missed, and complementarity is. */
static void off(block *b, int k, real *gap, real *missed) {
    EACH_STEP if (s->dt[0][k] > 0) violation(PATH, &s->g[0][0], &s->m[0][0], k, gap, missed);
    violation(END, &b->ge[0][0], &b->e[0][0], k, gap, missed);
}

static void unload(block *b, const problems *q, int k, int solved) {
    const int64_t n = b->n, j = b->job[k], empty = b->empty[k];
    for (int64_t t = empty; t <= n; ++t) {
        const step *s = &b->s[t];
        const int64_t row = t - empty;
        for (int i = 0; i < STATES; ++i) q->x_all[(j * (n + 1) + row) * STATES + i] = s->x[i][k];
        if (t == n) break;
        for (int i = 0; i < 2; ++i) q->a_all[(j * n + row) * 2 + i] = s->a[i][k];
        for (int i = 0; i < 2 * STATES; ++i) q->gains_all[(j * n + row) * 2 * STATES + i] = s->gain[i][k];
        for (int i = 0; i < STATES; ++i) q->slopes_all[(j * n + row) * STATES + i] = s->slope[i][k];
        for (int i = 0; i < PATH; ++i) q->path_prices[(j * n + row) * PATH + i] = s->m[i][k];
    }
    for (int i = 0; i < END; ++i) q->end_prices[j * END + i] = b->e[i][k];
    q->costs[j] = b->cost[k], q->solved[j] = solved;
    b->job[k] = -1, --b->active;
}

static void backwards(block *b) {
    end(AT(b->s[b->n].x), AT(b->e), AT(b->p), AT(b->width), AT(b->ahead[b->n & 1]), AT(b->value), AT(b->ge_new));
    int64_t t = b->n - 1;
    for (step *s = &b->s[t]; s >= b->first; --s, --t)
        sweep(AT(b->ahead[(t + 1) & 1]), AT(s->x), AT(s->a), AT(s->dt), AT(s->m), AT(b->p), AT(b->width), AT(b->damping),
              AT(s[1].x), AT(b->open), AT(b->ahead[t & 1]), AT(s->change), AT(s->gain), AT(s->slope));
    memcpy(b->promised, b->ahead[(t + 1) & 1][AHEAD - 1], sizeof b->promised);
    memcpy(b->first->x_new, b->first->x, sizeof b->first->x);
#if STATES > 8
    EACH_LANE { /* the length of the steps is free */
        const real first = b->ahead[0][AHEAD - 2][k], second = b->ahead[0][AHEAD - STATES - 2][k], h = b->first->x[8][k];
        const real most = 0.15 * h, wanted = second > 0 ? -first / second : -first * INFINITY;
        real move = b->share[0][k] * (wanted > most ? most : wanted < -most ? -most : wanted);
        if (!(move == move)) move = 0;
        const real low = b->p[PARAMS - 2][k], high = b->p[PARAMS - 1][k];
        b->first->x_new[8][k] = h + move < low ? low : h + move > high ? high : h + move;
        b->promised[k] -= first * (b->first->x_new[8][k] - h) / 2;
    }
#endif
}

/* Bends guesses that are no motions: a Newton step on the dynamics. */
static void bend_guesses(block *b) {
    memset(b->first->shift, 0, sizeof b->first->shift);
    EACH_LANE for (int i = 8; i < STATES; ++i) b->first->shift[i][k] = b->first->x_new[i][k] - b->first->x[i][k];
    EACH_STEP
        bend(AT(s->x), AT(s->shift), AT(s[1].x), AT(s->a), AT(s->change), AT(b->share), AT(s->gain), AT(s->dt), AT(b->p),
             AT(s[1].shift), AT(s->a_new));
    EACH_LANE if (b->job[k] >= 0 && b->tick[k] < b->o[k].bends) {
        EACH_STEP for (int i = 0; i < 2; ++i) s->a[i][k] = s->a_new[i][k];
        for (step *s = b->first; s <= b->s + b->n; ++s)
            for (int i = 0; i < STATES; ++i) s->x[i][k] += s->shift[i][k];
        ++b->tick[k];
    }
}

static void forwards(block *b) {
    EACH_LANE b->cost_new[k] = 0;
    EACH_STEP
        hold(AT(s->x_new), AT(s->a), AT(s->change), AT(b->share), AT(s->gain), AT(s->x), AT(s->dt), AT(b->p), AT(s->m),
             AT(b->width), AT(s[1].x_new), AT(s->a_new), AT(s->rate), AT(s->g_new), AT(s->priced));
    end(AT(b->s[b->n].x_new), AT(b->e), AT(b->p), AT(b->width), AT(b->ahead[1]), AT(b->value), AT(b->ge_new));
    EACH_STEP EACH_LANE b->cost_new[k] += s->rate[0][k];
    EACH_LANE {
        b->cost_new[k] += b->value[0][k];
        b->merit_new[k] = b->cost_new[k] + price(END, &b->ge_new[0][0], &b->e[0][0], b->width[0][k], k);
    }
    EACH_STEP EACH_LANE b->merit_new[k] += s->priced[0][k];
}

static void accept(block *b, int k) {
    EACH_STEP {
        for (int i = 0; i < 2; ++i) s->a[i][k] = s->a_new[i][k];
        for (int i = 0; i < PATH; ++i) s->g[i][k] = s->g_new[i][k];
        for (int i = 0; i < STATES; ++i) s[1].x[i][k] = s[1].x_new[i][k];
    }
    for (int i = 0; i < STATES; ++i) b->first->x[i][k] = b->first->x_new[i][k];
    for (int i = 0; i < END; ++i) b->ge[i][k] = b->ge_new[i][k];
    b->cost[k] = b->cost_new[k], b->merit[k] = b->merit_new[k];
}

/* New multipliers, and a narrower price. */
static void reprice(block *b, int k) {
    EACH_STEP if (s->dt[0][k] > 0) update(PATH, &s->g[0][0], &s->m[0][0], b->width[0][k], k);
    update(END, &b->ge[0][0], &b->e[0][0], b->width[0][k], k);
    b->width[0][k] = fmax(b->width[0][k] * SHRINK, LEAST_WIDTH);
    b->merit[k] = b->cost[k] + price(END, &b->ge[0][0], &b->e[0][0], b->width[0][k], k), b->share[0][k] = 1;
    EACH_STEP if (s->dt[0][k] > 0) b->merit[k] += price(PATH, &s->g[0][0], &s->m[0][0], b->width[0][k], k);
}

/* Takes or refuses the simulated step, and says whether the episode is solved, or -1 where it goes on. */
static int decide(block *b, int k) {
    const options *o = &b->o[k];
    const int tracked = b->tick[k] == o->bends;
    const int accepted = tracked ? isfinite(b->merit_new[k]) : b->merit_new[k] < b->merit[k];
    int solved = -1;
    if (accepted)
        accept(b, k);
    else if (tracked) /* the guess falls */
        solved = 0;
    const real used = b->share[0][k], scale = fabs(b->cost[k]) + 1e-12;
    b->share[0][k] = accepted ? 1 : used * 0.35;
    real *damping = &b->damping[0][k];
    *damping = !accepted ? fmin(*damping * 4 + 1e-3, 1e3) : used < 1 ? *damping : *damping * 0.2;
    if (*damping < 1e-6) *damping = 0;
    const int settled = b->promised[k] < o->tolerance * scale;
    const int stuck = !accepted && b->share[0][k] < 1e-3;
    if (solved < 0 && !tracked && (settled || stuck || (accepted && b->promised[k] < 1e-2 * scale))) {
        real gap = 0, missed = 0;
        off(b, k, &gap, &missed);
        if ((settled || stuck) && missed <= o->violation && gap <= 10 * o->tolerance * scale)
            solved = settled;
        else if (stuck && b->width[0][k] <= LEAST_WIDTH)
            solved = 0;
        else
            reprice(b, k);
    }
    return ++b->tick[k] >= ITERATIONS && solved < 0 ? 0 : solved;
}

/* Solves `jobs` episodes of at most n steps, each with its options. */
void solve(int64_t jobs, int64_t n, double length, const options *each, const int64_t *steps, const double *given, double *x,
           double *a, double *path_prices, double *end_prices, double *gains, double *slopes, double *costs, int64_t *solved) {
    const problems q = {length, steps, each, given, x, a, path_prices, end_prices, gains, slopes, costs, solved};
    block *b = calloc(1, sizeof *b + ((size_t)n + 1) * sizeof *b->s);
    b->n = n;
    int64_t next = 0;
    EACH_LANE b->job[k] = -1, b->width[0][k] = 1;
    for (;;) {
        int bending = 0, simulating = 0, bends[LANES];
        b->first = b->s + n;
        EACH_LANE {
            if (b->job[k] < 0 && next < jobs) load(b, &q, next++, k);
            if (b->job[k] >= 0 && b->s + b->empty[k] < b->first) b->first = b->s + b->empty[k];
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
            const int ended = decide(b, k);
            if (ended >= 0) unload(b, &q, k, ended);
        }
    }
    free(b);
}

/* Simulates the cascade along paths (jobs, n, 4) with its two settings where there are paths, and feedback where there is one:
   gains (jobs, 2, STATES), each with the state about which it is. x (jobs, n+1, STATES) has the initial states. */
void follow(int64_t jobs, int64_t n, double length, const double *given, const double *path_all, const double *settings,
            const double *feedback, double *x_all, double *a_all, double *costs, double *missed_all) {
    for (int64_t first = 0; first < jobs; first += LANES) {
        real x[2][STATES][LANES], a[2][LANES] = {{0}}, path[4][LANES], p[PARAMS + 1][LANES], set[2][LANES], rate[1][LANES];
        real dt[1][LANES], g[PATH + 1][LANES], cost[LANES] = {0}, missed[LANES] = {0}, zero[PATH + 3][LANES] = {{0}};
        real lqr[3 * STATES][LANES] = {{0}};
        real one[1][LANES], priced[1][LANES], taken[2][LANES];
        int64_t job[LANES];
        EACH_LANE {
            const int64_t j = job[k] = first + k < jobs ? first + k : first;
            one[0][k] = 1, dt[0][k] = length, set[0][k] = settings[0], set[1][k] = settings[1];
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
            }
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
