/* Printed code computes

   | function | from | to |
   |---|---|---|
   | bend | at, moved, p, weights | BENT entries of (∂at/∂z)ᵀ C ∂at/∂z, where C are second derivatives, Σ_i weights_i ∂²rates_i/∂at²; and
     Σ_i weights_i ∂rates_i/∂at |
   | weigh | moved, weights | Σ_i weights_i moved_i |

   Of the symmetric Hessian, each of the HESSIAN entries is the one at `bent_at` of these. */

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
