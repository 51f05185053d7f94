/* RK4 steps of an interval with their first and second derivatives, of LANES stages at once. codegen.py writes rates_jacobian
   and rates_hessian: the rates of the N states and their Jacobian, and the Hessian of their weighted sum, with respect to
   z, the N states and M inputs. An interval lasts 1, and takes STEPS steps.

   An entry of a matrix of WIDTH columns, one number per stage, is at (row * WIDTH + column) * LANES. */

enum { WIDTH = N + M, STAGES = 4 * STEPS };
#define EACH for (int k = 0; k < LANES; ++k)

typedef struct {
    real at[STAGES][WIDTH * LANES];               /* where rates are evaluated, */
    real slopes[STAGES][N * WIDTH * LANES];       /* with their Jacobian there, */
    real moved[STAGES][WIDTH * WIDTH * LANES];    /* and that of the place with respect to z */
    real end[N * LANES], ends[N * WIDTH * LANES]; /* the state after the interval, and its Jacobian */
} Sweep;

/* product += left (rows, inner) right (inner, WIDTH), for matrices whose rows of left are `inner` long */
static void add_product(int rows, int inner, const real *restrict left, const real *restrict right, real *restrict product) {
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < inner; ++j)
            for (int c = 0; c < WIDTH; ++c)
                EACH product[(i * WIDTH + c) * LANES + k] += left[(i * inner + j) * LANES + k] * right[(j * WIDTH + c) * LANES + k];
}

static const real AHEAD[4] = {0, 0.5, 0.5, 1}, SHARE[4] = {1 / 6.0, 1 / 3.0, 1 / 3.0, 1 / 6.0};

static void forward(const real *restrict z, const real *restrict p, Sweep *s) {
    const real h = 1 / (real)STEPS;
    real rate[N * LANES], change[N * WIDTH * LANES], start[N * LANES], starts[N * WIDTH * LANES];
    memcpy(s->end, z, sizeof s->end);
    memset(s->ends, 0, sizeof s->ends);
    for (int i = 0; i < N; ++i)
        EACH s->ends[(i * WIDTH + i) * LANES + k] = 1;
    for (int stage = 0; stage < STAGES; ++stage) {
        const int i = stage % 4;
        real *at = s->at[stage], *moved = s->moved[stage];
        if (i == 0) {
            memcpy(start, s->end, sizeof start);
            memcpy(starts, s->ends, sizeof starts);
            memset(rate, 0, sizeof rate);
            memset(change, 0, sizeof change);
        }
        memset(moved, 0, sizeof s->moved[stage]);
        for (int n = 0; n < N * LANES; ++n)
            at[n] = start[n] + h * AHEAD[i] * rate[n];
        memcpy(at + N * LANES, z + N * LANES, M * LANES * sizeof *z);
        for (int n = 0; n < N * WIDTH * LANES; ++n)
            moved[n] = starts[n] + h * AHEAD[i] * change[n];
        for (int n = N; n < WIDTH; ++n)
            EACH moved[(n * WIDTH + n) * LANES + k] = 1;
        rates_jacobian(at, LANES, p, LANES, rate, LANES, s->slopes[stage], LANES);
        memset(change, 0, sizeof change);
        add_product(N, WIDTH, s->slopes[stage], moved, change);
        for (int n = 0; n < N * LANES; ++n)
            s->end[n] += h * SHARE[i] * rate[n];
        for (int n = 0; n < N * WIDTH * LANES; ++n)
            s->ends[n] += h * SHARE[i] * change[n];
    }
}

static void value_lanes(const real *z, int64_t sz, const real *p, int64_t sp, real *out, int64_t sout) {
    Sweep s;
    forward(z, p, &s);
    memcpy(out, s.end, sizeof s.end);
}

static void jacobian_lanes(const real *z, int64_t sz, const real *p, int64_t sp, real *out, int64_t sout, real *jacobian,
                           int64_t sjacobian) {
    Sweep s;
    forward(z, p, &s);
    memcpy(out, s.end, sizeof s.end);
    for (int i = 0; i < N; ++i)
        for (int c = 0; c < WIDTH; ++c)
            memcpy(jacobian + (c * N + i) * LANES, s.ends + (i * WIDTH + c) * LANES, LANES * sizeof(real));
}

static void hessian_lanes(const real *z, int64_t sz, const real *p, int64_t sp, const real *l, int64_t sl, real *gradient,
                          int64_t sgradient, real *hessian, int64_t shessian) {
    const real h = 1 / (real)STEPS;
    Sweep s;
    real price[N * LANES], before[N * LANES], of_rate[4][N * LANES], curve[WIDTH * WIDTH * LANES];
    real curved[WIDTH * WIDTH * LANES], sum[WIDTH * WIDTH * LANES] = {0};
    forward(z, p, &s);
    memset(gradient, 0, WIDTH * LANES * sizeof *gradient);
    for (int i = 0; i < N; ++i)
        for (int c = 0; c < WIDTH; ++c)
            EACH gradient[c * LANES + k] += l[i * LANES + k] * s.ends[(i * WIDTH + c) * LANES + k];
    memcpy(price, l, sizeof price);
    for (int stage = STAGES - 1; stage >= 0; --stage) {
        const int i = stage % 4;
        const real *slopes = s.slopes[stage], *moved = s.moved[stage];
        if (i == 3) {
            memcpy(before, price, sizeof before);
            for (int j = 0; j < 4; ++j)
                for (int n = 0; n < N * LANES; ++n)
                    of_rate[j][n] = h * SHARE[j] * price[n];
        }
        rates_hessian(s.at[stage], LANES, p, LANES, of_rate[i], LANES, curve, LANES);
        memset(curved, 0, sizeof curved);
        add_product(WIDTH, WIDTH, curve, moved, curved);
        for (int j = 0; j < WIDTH; ++j)
            for (int r = 0; r < WIDTH; ++r)
                for (int c = r; c < WIDTH; ++c)
                    EACH sum[(r * WIDTH + c) * LANES + k] += moved[(j * WIDTH + r) * LANES + k] * curved[(j * WIDTH + c) * LANES + k];
        for (int c = 0; c < N; ++c) {
            real back[LANES] = {0};
            for (int j = 0; j < N; ++j)
                EACH back[k] += slopes[(j * WIDTH + c) * LANES + k] * of_rate[i][j * LANES + k];
            EACH before[c * LANES + k] += back[k];
            if (i > 0)
                EACH of_rate[i - 1][c * LANES + k] += h * AHEAD[i] * back[k];
        }
        if (i == 0)
            memcpy(price, before, sizeof price);
    }
    for (int c = 0; c < WIDTH; ++c)
        for (int r = 0; r < WIDTH; ++r)
            memcpy(hessian + (c * WIDTH + r) * LANES, sum + ((r < c ? r : c) * WIDTH + (r < c ? c : r)) * LANES, LANES * sizeof(real));
}
