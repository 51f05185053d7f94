/* STEPS steps of RK4 over a time of 1, of LANES stages at once. rk4_jacobian.c and rk4_hessian.c, which may follow, have their
   derivatives.

   z = [s, w] are STATES states and the inputs, WIDTH in all; w and the parameters p are held. A row has a number for each lane.
   Printed code computes

   | function | from | to |
   |---|---|---|
   | rates | at, p | the rates of the states at z = at | */

#include <string.h>

typedef real row[LANES];

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

static void value_lanes(const real *z, const real *p, real *next) {
    integrate((const row *)z, (const row *)p, (row *)next);
}
