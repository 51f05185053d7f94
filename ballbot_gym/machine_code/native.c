/* Batches of ballbots. The functions advance, look, draw_constants and draw_state are what codegen.py writes of a task and a robot.

   Row i of a pointer p, one number per robot, is at p + i * sp: rows are those of a whole batch, or of a block of LANES robots. */

#include <string.h>

#ifdef _WIN32
__declspec(dllimport) int __stdcall SwitchToThread(void);
#define YIELD SwitchToThread
#else
#include <sched.h>
#define YIELD sched_yield
#endif

/* states, constants, actions, numbers of steps taken and of a whole episode -> next states, forces, grip, pay, flags, violated limit */
static void advance(const real *restrict x, int64_t sx, const real *restrict c, int64_t sc, const real *restrict a, int64_t sa,
                    const real *restrict t, int64_t st, const real *restrict w, int64_t sw, real *restrict end, int64_t send,
                    real *restrict force, int64_t sforce, real *restrict grip, int64_t sgrip, real *restrict pay, int64_t spay,
                    real *restrict flags, int64_t sflags, real *restrict violated, int64_t sviolated);
/* states, constants, numbers of steps taken -> observations, measurements */
static void look(const real *restrict x, int64_t sx, const real *restrict c, int64_t sc, const real *restrict t, int64_t st,
                 real *restrict seen, int64_t sseen, real *restrict measured, int64_t smeasured);
/* random numbers -> constants */
static void draw_constants(const real *restrict z, int64_t sz, real *restrict c, int64_t sc);
/* random numbers, constants -> states */
static void draw_state(const real *restrict z, int64_t sz, const real *restrict c, int64_t sc, real *restrict x, int64_t sx);

/* Random numbers, as in seeding.py. */
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

/* Starts episodes in the count robots that which lists: states, and constants unless they are given. Its name and the next are
   ours alone, lest the linker takes another library's of the same name for the calls below. */
void ballbot_start(int64_t B, int64_t count, const int64_t *which, const int64_t *seed, const int64_t *episode, int given,
                  real *x, real *c) {
    for (int64_t m = 0; m < count; m += LANES) {
        real z[AT_LEAST_1(DRAWS) * LANES] = {0}, cs[AT_LEAST_1(CONSTANTS) * LANES] = {0}, xs[STATES * LANES];
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
            for (int i = 0; i < STATES; ++i)
                x[i * B + n] = xs[i * LANES + k];
            for (int i = 0; i < CONSTANTS; ++i)
                c[i * B + n] = cs[i * LANES + k];
        }
    }
}

/* What the count robots that which lists see, and their measurements. */
void ballbot_observe(int64_t B, int64_t count, const int64_t *which, const int64_t *steps, const real *x, const real *c,
                    real *seen, real *measured) {
    for (int64_t m = 0; m < count; m += LANES) {
        real xs[STATES * LANES] = {0}, cs[AT_LEAST_1(CONSTANTS) * LANES] = {0}, taken[LANES] = {0}, ss[SEEN * LANES], ms[AT_LEAST_1(MEASURED) * LANES];
        for (int k = 0; k < LANES && m + k < count; ++k) {
            taken[k] = (real)steps[which[m + k]];
            for (int i = 0; i < STATES; ++i)
                xs[i * LANES + k] = x[i * B + which[m + k]];
            for (int i = 0; i < CONSTANTS; ++i)
                cs[i * LANES + k] = c[i * B + which[m + k]];
        }
        look(xs, LANES, cs, LANES, taken, LANES, ss, LANES, ms, LANES);
        for (int k = 0; k < LANES && m + k < count; ++k) {
            for (int i = 0; i < SEEN; ++i)
                seen[i * B + which[m + k]] = ss[i * LANES + k];
            for (int i = 0; i < MEASURED; ++i)
                measured[i * B + which[m + k]] = ms[i * LANES + k];
        }
    }
}

/* Robots that a thread takes at once. */
enum { CHUNK = 32 * LANES };

/* Rows of a step: state and measurements after it, what it applied: force and the floor's grip, and the observation after it. */
enum { MEASUREMENTS = STATES, FORCE = STATES + MEASURED, GRIPPED = FORCE + ACTIONS, SIGHT = GRIPPED + GRIP, ROWS = SIGHT + SEEN };

/* Rows of flags, which are those of step.FLAGS; and how many there are of pay, which are those of step.PAY. */
enum { TERMINATED, TRUNCATED };
enum { PAYS = 5 };

/* Rows of counts: the violated limit, and the steps and the episode of the robot now. */
enum { VIOLATED, STEPS, EPISODE };

/* What a step reads and writes, in the order of native._Memory. The memory is that of rows of B numbers. */
typedef struct {
    int64_t taken, done; /* robots that threads have taken, and finished */
    int64_t B;
    int64_t most;        /* control steps, after which an episode is truncated */
    int64_t episode_steps; /* control steps of an episode of the task */
    int64_t bad;         /* whether an action is not finite */
    int64_t env, component; /* how far apart the actions of robots are, and the components of one, in numbers */
    const real *x, *c, *action;
    const int64_t *steps, *episode, *seed;
    const uint8_t *idle; /* whose action is ignored, and whose next episode begins; null where there are none */
    int64_t restarts;    /* whether episodes begin where others end */
    real *end;           /* ROWS */
    real *now, *seen;    /* state and measurements, and observations, once episodes have begun; unless restarts, those of end */
    real *new_c;         /* CONSTANTS rows of the episodes then */
    double *pay;         /* PAYS rows */
    uint8_t *flags;      /* FLAGS rows */
    int64_t *counts;     /* 3 rows */
} Memory;

/* Writes the rewards, costs and flags of robots n to n + count - 1. If count is a constant, the compiler makes SIMD of it. */
static inline __attribute__((always_inline)) void write_outcome(const Memory *m, int64_t n, int64_t count,
                                                                const real *paid, const real *marks, const real *limit) {
    const int64_t B = m->B;
    double *const pay = m->pay + n;
    uint8_t *const flags = m->flags + n;
    int64_t *const counts = m->counts + n;
    for (int i = 0; i < PAYS; ++i)
        for (int64_t k = 0; k < count; ++k)
            pay[i * B + k] = paid[i * LANES + k];
    for (int64_t k = 0; k < count; ++k) {
        counts[VIOLATED * B + k] = (int64_t)limit[k];
        counts[STEPS * B + k] = m->steps[n + k] + 1;
    }
    for (int i = 0; i < FLAGS; ++i)
        for (int64_t k = 0; k < count; ++k)
            flags[i * B + k] = (uint8_t)(marks[i * LANES + k] != 0);
    for (int64_t k = 0; k < count; ++k)
        flags[TRUNCATED * B + k] |= (uint8_t)(!flags[TERMINATED * B + k] & (counts[STEPS * B + k] >= m->most));
}

/* One control step of robots n to n + count - 1, at most LANES, and what they see then; no episode begins. */
static void step_block(Memory *m, int64_t n, int64_t count) {
    const int64_t B = m->B;
    const real *const action = m->action + n * m->env;
    real *const end = m->end + n;
    real taken[LANES] = {0}, after[LANES] = {0}, whole[LANES], acts[ACTIONS * LANES] = {0}, paid[PAYS * LANES], marks[FLAGS * LANES], limit[LANES], off = 0;
    for (int64_t k = 0; k < count; ++k) {
        for (int i = 0; i < ACTIONS; ++i)
            acts[i * LANES + k] = action[k * m->env + i * m->component];
        taken[k] = (real)m->steps[n + k];
        after[k] = taken[k] + 1;
    }
    for (int k = 0; k < LANES; ++k)
        whole[k] = (real)m->episode_steps;
    for (int k = 0; k < ACTIONS * LANES; ++k)
        off += acts[k] - acts[k]; /* not a number, unless all are finite */
    if (!(off == 0))
        __atomic_store_n(&m->bad, 1, __ATOMIC_RELAXED);
    if (count == LANES) {
        advance(m->x + n, B, m->c + n, B, acts, LANES, taken, LANES, whole, LANES, end, B, end + FORCE * B, B,
                end + GRIPPED * B, B, paid, LANES, marks, LANES, limit, LANES);
        look(end, B, m->c + n, B, after, LANES, end + SIGHT * B, B, end + MEASUREMENTS * B, B);
        write_outcome(m, n, LANES, paid, marks, limit);
    } else {
        real in[(STATES + CONSTANTS) * LANES] = {0}, out[ROWS * LANES];
        real *const cs = in + STATES * LANES;
        rows_copy(STATES, count, m->x + n, B, in, LANES);
        rows_copy(CONSTANTS, count, m->c + n, B, cs, LANES);
        advance(in, LANES, cs, LANES, acts, LANES, taken, LANES, whole, LANES, out, LANES, out + FORCE * LANES, LANES,
                out + GRIPPED * LANES, LANES, paid, LANES, marks, LANES, limit, LANES);
        look(out, LANES, cs, LANES, after, LANES, out + SIGHT * LANES, LANES, out + MEASUREMENTS * LANES, LANES);
        rows_copy(ROWS, count, out, LANES, end, B);
        write_outcome(m, n, count, paid, marks, limit);
    }
}

/* Robot n of rows of numbers becomes 0. */
#define CLEAR(rows, pointer) for (int i = 0; i < (rows); ++i) (pointer)[i * B + n] = 0

/* The step of the robots first to last - 1, and the starts of their next episodes. */
static void step_chunk(Memory *m, int64_t first, int64_t last) {
    const int64_t B = m->B, size = last - first;
    int64_t begun[CHUNK], count = 0;
    int64_t *const steps = m->counts + STEPS * B, *const episode = m->counts + EPISODE * B;
    for (int64_t n = first; n < last; n += LANES)
        step_block(m, n, last - n < LANES ? last - n : LANES);
    rows_copy(CONSTANTS, size, m->c + first, B, m->new_c + first, B);
    memcpy(episode + first, m->episode + first, size * sizeof *episode);
    if (m->restarts) {
        rows_copy(FORCE, size, m->end + first, B, m->now + first, B);
        rows_copy(SEEN, size, m->end + SIGHT * B + first, B, m->seen + first, B);
    }
    for (int64_t n = first; n < last; ++n) {
        const int idle = m->idle && m->idle[n];
        if (idle) {
            CLEAR(SIGHT - FORCE, m->end + FORCE * B);
            CLEAR(PAYS, m->pay);
            CLEAR(FLAGS, m->flags);
            m->counts[VIOLATED * B + n] = -1;
        }
        if (idle || (m->restarts && (m->flags[TERMINATED * B + n] | m->flags[TRUNCATED * B + n]))) {
            steps[n] = 0;
            episode[n] += 1;
            begun[count++] = n;
        }
    }
    ballbot_start(B, count, begun, m->seed, episode, 0, m->now, m->new_c);
    ballbot_observe(B, count, begun, steps, m->now, m->new_c, m->seen, m->now + MEASUREMENTS * B);
}

/* One control step of a batch. Threads that call it with the same memory take chunks in turns, until all are done. */
void step(Memory *m) {
    for (;;) {
        const int64_t first = __atomic_fetch_add(&m->taken, CHUNK, __ATOMIC_RELAXED);
        if (first >= m->B)
            break;
        const int64_t last = first + CHUNK < m->B ? first + CHUNK : m->B;
        step_chunk(m, first, last);
        __atomic_fetch_add(&m->done, last - first, __ATOMIC_RELEASE);
    }
    while (__atomic_load_n(&m->done, __ATOMIC_ACQUIRE) < m->B) /* other threads finish their last chunks */
        YIELD();
}
