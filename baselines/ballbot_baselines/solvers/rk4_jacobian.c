/* `moved` is ∂s/∂z, of which only the MOVED entries that are not 0 everywhere are stored; `same` is the identity, stored in the
   same way. Printed code computes

   | function | from | to |
   |---|---|---|
   | change | at, moved, p | the rates, and ∂rates/∂z where ∂at/∂z = moved | */

typedef struct {
    row at[WIDTH];
    row moved[MOVED];
} place; /* where rates are evaluated */

static _Thread_local place places[4 * STEPS]; /* with many steps they would not fit on the stack of a thread */

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

static void jacobian_lanes(const real *z, const real *p, real *next, real *moved) {
    differentiate((const row *)z, (const row *)p, (row *)next, (row *)moved);
}
