/* STEPS steps of RK4 over a time of 1, with their derivatives, the second ones if HESSIAN is defined, of LANES stages at once.

   z = [s, w] are STATES states and the inputs, WIDTH in all; w and the parameters p are held. `moved` is ∂s/∂z, of which only the
   MOVED entries that are not 0 everywhere are stored. A row has a number for each lane. Printed code computes

   | function | from | to |
   |---|---|---|
   | rates | at, p | the rates of the states at z = at |
   | change | at, moved, p | the same, and ∂rates/∂z where ∂at/∂z = moved |
   | bend | at, moved, p, weights | BENT entries of Σ_i weights_i ∂²rates_i/∂z², where ∂at/∂z = moved, without the part of its own second
     derivatives; and Σ_i weights_i ∂rates_i/∂at |
   | weigh | moved, weights | Σ_i weights_i moved_i | */

#include <string.h>

typedef real row[LANES];

typedef struct {
    row at[WIDTH];
    row moved[MOVED];
} place; /* where rates are evaluated */

static _Thread_local place places[4 * STEPS]; /* with many steps they would not fit on the stack of a thread */

static const real ahead[4] = {0, 0.5, 0.5, 1}, share[4] = {(real)1 / 6, (real)1 / 3, (real)1 / 3, (real)1 / 6};
static const real length = (real)1 / STEPS;

static inline void copy(int count, const row *from, row *to) {
    memcpy(to, from, (size_t)count * sizeof(row));
}

/* to = base + factor · from; they may be the same rows */
static inline void add(int count, const row *base, real factor, const row *from, row *to) {
    for (int i = 0; i < count; ++i) {
        #pragma omp simd
        for (int k = 0; k < LANES; ++k)
            to[i][k] = base[i][k] + factor * from[i][k];
    }
}

static void integrate(const row *z, const row *p, row *next) {
    row at[WIDTH], begin[STATES], rate[STATES] = {{0}};
    copy(WIDTH, z, at);
    copy(STATES, z, next);
    for (int step = 0; step < STEPS; ++step) {
        copy(STATES, next, begin);
        for (int i = 0; i < 4; ++i) {
            add(STATES, begin, length * ahead[i], rate, at);
            rates(at[0], LANES, p[0], LANES, rate[0], LANES);
            add(STATES, next, length * share[i], rate, next);
        }
    }
}

/* The next state, its derivatives, and the places where rates were evaluated on the way. */
static void differentiate(const row *z, const row *p, row *next, row *moved) {
    row begin[STATES], began[MOVED], rate[STATES] = {{0}}, changed[MOVED] = {{0}};
    copy(STATES, z, next);
    for (int i = 0; i < MOVED; ++i)
        for (int k = 0; k < LANES; ++k)
            moved[i][k] = same[i];
    for (int step = 0; step < STEPS; ++step) {
        copy(STATES, next, begin);
        copy(MOVED, moved, began);
        for (int i = 0; i < 4; ++i) {
            place *here = places + 4 * step + i;
            add(STATES, begin, length * ahead[i], rate, here->at);
            copy(WIDTH - STATES, z + STATES, here->at + STATES);
            add(MOVED, began, length * ahead[i], changed, here->moved);
            change(here->at[0], LANES, here->moved[0], LANES, p[0], LANES, rate[0], LANES, changed[0], LANES);
            add(STATES, next, length * share[i], rate, next);
            add(MOVED, moved, length * share[i], changed, moved);
        }
    }
}

static void value_lanes(const real *z, const real *p, real *next) {
    integrate((const row *)z, (const row *)p, (row *)next);
}

static void jacobian_lanes(const real *z, const real *p, real *next, real *moved) {
    differentiate((const row *)z, (const row *)p, (row *)next, (row *)moved);
}

#ifdef HESSIAN

/* Backwards, each place adds to the second derivatives by how much its rates count in what is weighted at the end. */
static void curve(const row *p, const row *weights, row *bent) {
    row price[STATES], before[STATES], behind[STATES], counts[STATES], back[STATES], more[BENT + 1];
    copy(STATES, weights, price);
    memset(bent, 0, BENT * sizeof(row));
    for (int step = STEPS - 1; step >= 0; --step) {
        copy(STATES, price, before);
        memset(behind, 0, sizeof behind);
        for (int i = 3; i >= 0; --i) {
            const place *here = places + 4 * step + i;
            add(STATES, behind, length * share[i], price, counts);
            bend(here->at[0], LANES, here->moved[0], LANES, p[0], LANES, counts[0], LANES, more[0], LANES, back[0], LANES);
            add(BENT, bent, 1, more, bent);
            add(STATES, before, 1, back, before);
            for (int j = 0; j < STATES; ++j)
                for (int k = 0; k < LANES; ++k)
                    behind[j][k] = length * ahead[i] * back[j][k];
        }
        copy(STATES, before, price);
    }
}

static void hessian_lanes(const real *z, const real *p, const real *weights, real *gradient, real *entries) {
    row next[STATES], moved[MOVED], bent[BENT + 1];
    differentiate((const row *)z, (const row *)p, next, moved);
    weigh(moved[0], LANES, weights, LANES, gradient, LANES);
    curve((const row *)p, (const row *)weights, bent);
    for (int i = 0; i < HESSIAN; ++i)
        copy(1, bent + bent_at[i], (row *)entries + i);
}

#endif
