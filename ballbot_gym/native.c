/* Batches of ballbots. The functions advance, look, draw_constants and draw_state are what codegen.py writes of a task and a robot.

   Row i of a pointer p, one number per robot, is at p + i * sp: rows are those of a whole batch, or of a block of LANES robots. */

/* states, constants, actions and numbers of steps taken -> next states, forces, grip, rewards and costs, flags, violated limit */
static void advance(const real *restrict x, int64_t sx, const real *restrict c, int64_t sc, const real *restrict a, int64_t sa,
                    const real *restrict t, int64_t st, real *restrict end, int64_t send, real *restrict force, int64_t sforce,
                    real *restrict grip, int64_t sgrip, real *restrict pay, int64_t spay, real *restrict flags, int64_t sflags,
                    real *restrict violated, int64_t sviolated);
/* states, constants -> observations, tilts */
static void look(const real *restrict x, int64_t sx, const real *restrict c, int64_t sc, real *restrict seen, int64_t sseen,
                 real *restrict tilt, int64_t stilt);
/* random numbers -> constants */
static void draw_constants(const real *restrict z, int64_t sz, real *restrict c, int64_t sc);
/* random numbers, constants -> states */
static void draw_state(const real *restrict z, int64_t sz, const real *restrict c, int64_t sc, real *restrict x, int64_t sx);

/* Random numbers, as in counter_rng.py. */
static uint32_t mix(uint32_t word) {
    word = (word ^ (word >> 16)) * 0x21F0AAADu;
    word = (word ^ (word >> 15)) * 0x735A2D97u;
    return word ^ (word >> 15);
}

static uint32_t key(int64_t seed, int64_t episode) {
    return mix(mix(mix(mix((uint32_t)seed) ^ (uint32_t)(seed >> 32)) ^ (uint32_t)episode));
}

#define AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

/* Copies rows of count numbers between a batch and a block. */
static void rows_copy(int rows, int64_t count, const real *from, int64_t sfrom, real *to, int64_t sto) {
    for (int i = 0; i < rows; ++i)
        for (int64_t k = 0; k < count; ++k)
            to[i * sto + k] = from[i * sfrom + k];
}

/* One control step of the robots first to last - 1 of a batch of B, and what they see then. first is a multiple of LANES. */
void step(int64_t B, int64_t first, int64_t last, const real *x, const real *c, const real *action, const int64_t *steps,
          real *end, real *seen, real *tilt, real *force, real *grip, double *pay, uint8_t *flags, int64_t *violated) {
    for (int64_t n = first; n < last; n += LANES) {
        const int64_t count = last - n < LANES ? last - n : LANES;
        real taken[LANES], paid[2 * LANES], marks[FLAGS * LANES], limit[LANES];
        for (int k = 0; k < LANES; ++k)
            taken[k] = (real)(k < count ? steps[n + k] : 0);
        if (count == LANES) {
            advance(x + n, B, c + n, B, action + n, B, taken, LANES,
                    end + n, B, force + n, B, grip + n, B, paid, LANES, marks, LANES, limit, LANES);
            look(end + n, B, c + n, B, seen + n, B, tilt + n, B);
        } else {
            real in[(10 + CONSTANTS) * LANES] = {0}, out[(11 + GRIP + SEEN) * LANES];
            real *const cs = in + 8 * LANES, *const as = cs + CONSTANTS * LANES;
            real *const fs = out + 8 * LANES, *const gs = fs + 2 * LANES, *const ss = gs + GRIP * LANES;
            real *const ts = ss + SEEN * LANES;
            rows_copy(8, count, x + n, B, in, LANES);
            rows_copy(CONSTANTS, count, c + n, B, cs, LANES);
            rows_copy(2, count, action + n, B, as, LANES);
            advance(in, LANES, cs, LANES, as, LANES, taken, LANES,
                    out, LANES, fs, LANES, gs, LANES, paid, LANES, marks, LANES, limit, LANES);
            look(out, LANES, cs, LANES, ss, LANES, ts, LANES);
            rows_copy(8, count, out, LANES, end + n, B);
            rows_copy(2, count, fs, LANES, force + n, B);
            rows_copy(GRIP, count, gs, LANES, grip + n, B);
            rows_copy(SEEN, count, ss, LANES, seen + n, B);
            rows_copy(1, count, ts, LANES, tilt + n, B);
        }
        for (int i = 0; i < 2; ++i)
            for (int64_t k = 0; k < count; ++k)
                pay[i * B + n + k] = paid[i * LANES + k];
        for (int i = 0; i < FLAGS; ++i)
            for (int64_t k = 0; k < count; ++k)
                flags[i * B + n + k] = (uint8_t)(marks[i * LANES + k] != 0);
        for (int64_t k = 0; k < count; ++k)
            violated[n + k] = (int64_t)limit[k];
    }
}

/* Starts episodes in the count robots that which lists: states, and constants unless they are given. */
void start(int64_t B, int64_t count, const int64_t *which, const int64_t *seed, const int64_t *episode, int given,
           real *x, real *c) {
    for (int64_t m = 0; m < count; m += LANES) {
        real z[AT_LEAST_1(DRAWS) * LANES] = {0}, cs[AT_LEAST_1(CONSTANTS) * LANES] = {0}, xs[8 * LANES];
        for (int k = 0; k < LANES && m + k < count; ++k) {
            const int64_t n = which[m + k];
            const uint32_t word = key(seed[n], episode[n]); /* of step 0 */
            for (int i = 0; i < DRAWS; ++i)
                z[i * LANES + k] = (real)(mix(word + 0x9E3779B9u * (uint32_t)(i + 1)) >> 8) * (real)5.9604644775390625e-08;
            for (int i = 0; i < CONSTANTS; ++i)
                cs[i * LANES + k] = c[i * B + n];
        }
        if (!given)
            draw_constants(z, LANES, cs, LANES);
        draw_state(z + CONSTANT_DRAWS * LANES, LANES, cs, LANES, xs, LANES);
        for (int k = 0; k < LANES && m + k < count; ++k) {
            const int64_t n = which[m + k];
            for (int i = 0; i < 8; ++i)
                x[i * B + n] = xs[i * LANES + k];
            for (int i = 0; i < CONSTANTS; ++i)
                c[i * B + n] = cs[i * LANES + k];
        }
    }
}

/* What the count robots that which lists see, and their tilts. */
void observe(int64_t B, int64_t count, const int64_t *which, const real *x, const real *c, real *seen, real *tilt) {
    for (int64_t m = 0; m < count; m += LANES) {
        real xs[8 * LANES] = {0}, cs[AT_LEAST_1(CONSTANTS) * LANES] = {0}, ss[SEEN * LANES], ts[LANES];
        for (int k = 0; k < LANES && m + k < count; ++k) {
            for (int i = 0; i < 8; ++i)
                xs[i * LANES + k] = x[i * B + which[m + k]];
            for (int i = 0; i < CONSTANTS; ++i)
                cs[i * LANES + k] = c[i * B + which[m + k]];
        }
        look(xs, LANES, cs, LANES, ss, LANES, ts, LANES);
        for (int k = 0; k < LANES && m + k < count; ++k) {
            for (int i = 0; i < SEEN; ++i)
                seen[i * B + which[m + k]] = ss[i * LANES + k];
            tilt[which[m + k]] = ts[k];
        }
    }
}
