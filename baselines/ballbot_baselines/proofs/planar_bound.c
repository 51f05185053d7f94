/* Checks a lower bound of the cost of every successful episode of Stabilize in a vertical plane, from V's coefficients alone.

States are x = (position, lean, speed, lean rate) = T z, forces u. F is a control step as the environment computes it: two RK4
steps of dt/2 with the force held. l is the cost rate. V is an even polynomial of degree at most 8 in z, and Q = z'z. V is
used where Q <= 1. With D = {Q <= 1, V < rho} and k control steps left, let

    W_k(x) = min(max(V(x) - delta, a_k V(x)), rho - delta) in D, else rho - delta,   a_0 = 0,  a_k+1 = min(1, a_k + dt r(a_k)),

where r is piecewise linear between knots, the last of which is a = 1, and V <= delta < rho and Q <= 1 in the goal.
If W_k+1(x) <= dt l(x, u) + W_k(F(x, u)) for all x and F(x, u) inside the limits and all |u| <= limit, then an episode of n steps
that ends in the goal costs at least W_n(x_0), because W_0 = 0 in the goal. It is enough that

  (A) V >= 0 for all x inside the limits with Q <= 1, and for all x inside the limits and all |u| <= limit
  (B) dt l >= rho, or dt l + V(F) >= rho, or Q(F) > 1, or Q <= 1 and either dt l >= V or, for every knot with
      V < until, a (V(F) - V)/dt + l >= r V.   `until` is at least delta/(1 - a') for all a' between the knot and what follows the next one.

Reasons: 0 <= W_k <= rho - delta. Where W_k(F) = rho - delta, as where Q(F) > 1, nothing is to be shown. Else F is in D, and W_k(F)
is at least V(F) - delta, a_k V(F) and 0. If Q <= 1 but x is not in D, the last knot gives dt l + V(F) >= V >= rho. If x is in D,
then W_k+1(x) is V - delta, and the last knot is enough, or it is a_k+1 V with V <= delta/(1 - a_k+1), and the knots about a_k are.

z = s y with max |y_i| = 1 and sigma = s^2, and u = s (gain y + w). Since F is odd and V even, all of (A) and (B) can be divided by
sigma, and what remains is smooth in (sigma, y, w) down to sigma = 0. A box is an interval of each of sigma, three components of y
and w; the fourth component of y, its `face`, is 1. A box that cannot be proven is halved. check() returns 0 if all of it is proven.

Arithmetic: a function on a box is a Taylor model, a polynomial of degree ORDER in five variables in [-1, 1], whose coefficients
are exact numbers, and a bound r of the distance from it. Each operation adds to r what it drops and what it rounds, by
|fl(a o b) - a o b| <= 2^-53 |a o b|, so compilers may fuse operations, but not -ffast-math. ROUND and SLACK are over 50 times as large
as needed: no sum has more than 400 terms. LANES boxes are computed at once. No comparison holds for what is not finite. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define ORDER 4
#define VARS 5
#define TERMS 126 /* monomials of degree <= ORDER in VARS variables */
#define LANES 8
#define KNOTS 16
#define ROUND 1e-14
#define SLACK (1 + 1e-12)
#define EACH(i, n) for (int i = 0; i < (n); i++)

typedef double real __attribute__((vector_size(8 * LANES)));
typedef int64_t mask __attribute__((vector_size(8 * LANES)));
static real all(double a) { return a - (real){0}; }
static real size(real a) { return (real)((mask)a & INT64_MAX); }
static real where(mask k, real a, real b) { return (real)((k & (mask)a) | (~k & (mask)b)); }

typedef struct {
    double mass, moment, inertia, gravity, dt, limit, reach[4], state_cost[4], force_cost; /* reach: of position and lean, and 0 */
    double t[4][4], gain[4], widest, rho, a[KNOTS], r[KNOTS], until[KNOTS]; /* |w| <= widest in the boxes */
    double c2[10], c4[35], c6[35][10], c8[35][35]; /* of products of i <= j <= ... of z: the first two or four, then the rest */
    int64_t knots;
} problem;
static problem P;

/* Taylor models */
static int from[ORDER + 2], degree_of[TERMS], power[TERMS][VARS], product[TERMS][TERMS], square[VARS][VARS];
typedef struct { real c[TERMS], r; int top; } model; /* no term has a degree above top */

static real norm(const model *a, real by[ORDER + 1]) { /* the sum of |c|, and the sums of each degree */
    real sum = all(0);
    EACH(d, a->top + 1) {
        real s[4] = {all(0), all(0), all(0), all(0)}; /* four sums at once, because each addition waits for the last one */
        int k = from[d];
        for (; k + 4 <= from[d + 1]; k += 4) EACH(i, 4) s[i] += size(a->c[k + i]);
        for (; k < from[d + 1]; k++) s[0] += size(a->c[k]);
        s[0] = (s[0] + s[1]) + (s[2] + s[3]), sum += s[0];
        if (by) by[d] = s[0];
    }
    if (by) for (int d = a->top + 1; d <= ORDER; d++) by[d] = all(0);
    return sum;
}
static void number(model *out, double a) {
    memset(out, 0, sizeof *out);
    out->c[0] = all(a);
}
static void add(model *out, const model *a, double s, const model *b) { /* a + s b */
    int top = a->top > b->top ? a->top : b->top;
    real sum[7];
    EACH(i, 7) sum[i] = all(0);
    EACH(n, TERMS / 7) EACH(i, 7) {
        int k = 7 * n + i;
        sum[i] += size(a->c[k]) + fabs(s) * size(b->c[k]);
        out->c[k] = a->c[k] + s * b->c[k];
    }
    real r = a->r + fabs(s) * b->r + ROUND * ((sum[0] + sum[1] + sum[2]) + (sum[3] + sum[4] + sum[5] + sum[6]));
    out->r = r * SLACK, out->top = top;
}
static void divide(model *a, real s) {
    EACH(k, TERMS) a->c[k] /= s;
    a->r = (a->r / size(s) + ROUND * norm(a, 0)) * SLACK;
}
static void scale(model *a, double s) {
    EACH(k, TERMS) a->c[k] *= s;
    a->r = (a->r * fabs(s) + ROUND * norm(a, 0)) * SLACK;
}
static void times(model *out, const model *a, const model *b) { /* faster if a has few terms */
    if (a->top > b->top) { const model *other = a; a = b, b = other; }
    int top = a->top + b->top < ORDER ? a->top + b->top : ORDER, apart = out != a && out != b;
    real room[TERMS], *p = apart ? out->c : room;
    real na[ORDER + 1], nb[ORDER + 1], sa = norm(a, na), sb = norm(b, nb), lost = all(0);
    EACH(k, TERMS) p[k] = a->c[0] * b->c[k];
    for (int i = 1; i < from[a->top + 1]; i++) {
        int most = ORDER - degree_of[i], end = from[(most < b->top ? most : b->top) + 1];
        real ai = a->c[i];
        int64_t any = ((mask)ai)[0];
        if (!any) EACH(l, LANES) any |= ((mask)ai)[l];
        if (any) EACH(j, end) p[product[i][j]] += ai * b->c[j];
    }
    EACH(d, ORDER + 1) for (int e = ORDER + 1 - d; e <= ORDER; e++) lost += na[d] * nb[e];
    out->r = (lost + a->r * (sb + b->r) + b->r * sa + ROUND * sa * sb) * SLACK;
    if (!apart) EACH(k, TERMS) out->c[k] = p[k];
    out->top = top;
}
static void range(const model *a, real *low, real *high) {
    real sum = (norm(a, 0) - size(a->c[0]) + a->r + ROUND * norm(a, 0)) * SLACK;
    *low = a->c[0] - sum, *high = a->c[0] + sum;
    *low -= ROUND * size(*low), *high += ROUND * size(*high);
}

static double series[2][5][16]; /* k-th Taylor coefficients of sin(a)/a and of cos(a) as power series of t = a^2 */
static void sine_cosine(const model *t, model *s, model *c) { /* |t| <= 10: of degree 3 about its middle, and a remainder */
    model d = *t, d2, d3;
    d.c[0] = all(0);
    real far = (norm(&d, 0) + d.r) * SLACK, outside = where(size(t->c[0]) + far < 10, all(0), all(INFINITY));
    times(&d2, &d, &d), times(&d3, &d2, &d);
    EACH(f, 2) {
        model *out = f ? c : s;
        real at[4];
        double most = 0; /* of the fourth coefficient where |t| <= 10 */
        EACH(k, 4) {
            at[k] = all(0);
            for (int j = 15; j >= k; j--) at[k] = at[k] * t->c[0] + series[f][k][j];
        }
        for (int j = 15; j >= 4; j--) most = most * 10 + fabs(series[f][4][j]);
        EACH(k, TERMS) out->c[k] = at[1] * d.c[k] + at[2] * d2.c[k] + at[3] * d3.c[k];
        out->c[0] += at[0], out->top = ORDER;
        out->r = size(at[1]) * d.r + size(at[2]) * d2.r + size(at[3]) * d3.r + 1.01 * most * far * far * far * far;
        out->r = (out->r + 20 * ROUND * (1 + far + far * far + far * far * far)) * SLACK + outside;
    }
}
static void inverse(model *out, const model *g) { /* 1/g = (1 - d)(1 + d^2)(1 + d^4)/g_0 + ..., with d = g/g_0 - 1 */
    model d = *g, q, p;
    real middle = g->c[0];
    divide(&d, middle);
    d.c[0] = all(0), d.r += ROUND;
    real far = (norm(&d, 0) + d.r) * SLACK, f2 = far * far, f4 = f2 * f2;
    times(&q, &d, &d);
    number(&p, 1), add(&p, &p, -1, &d);
    times(out, &p, &q), add(out, out, 1, &p);
    times(&q, &q, &q), times(&p, out, &q), add(out, out, 1, &p);
    out->r += where(far < 0.9, f4 * f4 / (1 - far) * SLACK, all(INFINITY));
    divide(out, middle);
}

/* The robot's equations divided by s. sigma = 0 is the linear robot. */
static void accelerations(const model *sigma, const model *lean, const model *rate, const model *force, model *dv, model *dw) {
    model t, s, c, pull, g, a;
    times(&t, lean, lean), times(&t, &t, sigma);
    sine_cosine(&t, &s, &c);
    times(&s, &s, lean);
    times(&pull, rate, rate), times(&pull, &pull, &s), times(&pull, &pull, sigma);
    add(&pull, force, P.moment, &pull); /* force + moment sin(lean) rate^2 */
    times(&a, &c, &c), scale(&a, P.moment), scale(&a, P.moment), divide(&a, all(P.mass));
    number(&g, P.inertia), add(&g, &g, -1, &a), inverse(&g, &g);
    times(&a, &c, &pull), divide(&a, all(P.mass)), scale(&s, P.gravity), add(&a, &s, -1, &a), scale(&a, P.moment);
    times(dw, &a, &g); /* moment (gravity sin(lean) - cos(lean) pull/mass) / (inertia - moment^2 cos(lean)^2/mass) */
    times(&a, &c, dw), scale(&a, P.moment), add(&a, &pull, -1, &a), divide(&a, all(P.mass));
    *dv = a;
}
static void step(const model *sigma, const model x[4], const model *force, model out[4]) { /* (F - x)/dt */
    double h = P.dt / 2;
    model lean = x[1], speed = x[2], rate = x[3], kv[4], kw[4], a, b, w2, w3;
    EACH(i, 4) number(&out[i], 0);
    EACH(half, 2) {
        accelerations(sigma, &lean, &rate, force, &kv[0], &kw[0]);
        add(&a, &lean, h / 2, &rate), add(&w2, &rate, h / 2, &kw[0]);
        accelerations(sigma, &a, &w2, force, &kv[1], &kw[1]);
        add(&a, &lean, h / 2, &w2), add(&w3, &rate, h / 2, &kw[1]);
        accelerations(sigma, &a, &w3, force, &kv[2], &kw[2]);
        add(&a, &lean, h, &w3), add(&b, &rate, h, &kw[2]);
        accelerations(sigma, &a, &b, force, &kv[3], &kw[3]);
        EACH(leans, 2) {
            model *k = leans ? kw : kv, *first = leans ? &rate : &speed, *place = &out[leans], *change = &out[2 + leans], sum;
            add(&sum, &k[0], 1, &k[1]), add(&sum, &sum, 1, &k[2]), divide(&sum, all(6));
            add(place, place, 0.5, first), add(place, place, h / 2, &sum); /* h first + h^2 (k1 + k2 + k3)/6, over 2h */
            if (leans) add(&lean, &lean, h, first), add(&lean, &lean, h * h, &sum);
            add(&sum, &k[1], 1, &k[2]), add(&sum, &k[0], 2, &sum), add(&sum, &sum, 1, &k[3]), divide(&sum, all(6));
            add(change, change, 0.5, &sum), add(first, first, h, &sum);
        }
    }
}

/* V/sigma and Q/sigma, each with its change in a step over dt, so that nothing cancels */
typedef struct { model at, change; } pair;
static void pair_times(pair *out, const pair *a, const pair *b) {
    model after, p, q;
    add(&after, &b->at, P.dt, &b->change), times(&p, &a->change, &after), times(&q, &a->at, &b->change);
    times(&out->at, &a->at, &b->at), add(&out->change, &p, 1, &q);
}
static void pair_add(pair *out, double s, const pair *b) {
    add(&out->at, &out->at, s, &b->at), add(&out->change, &out->change, s, &b->change);
}
static void value(const model *sigma, const pair z[4], pair *v) {
    static _Thread_local pair one[10], two[10], four[35], middle, rest, t, zero; /* one: products of two z; two: those times sigma */
    int n = 0, a = 0, of[4][4];
    number(&zero.at, 0), number(&zero.change, 0), *v = zero;
    EACH(i, 4) for (int j = i; j < 4; j++, n++) {
        of[i][j] = n, pair_times(&one[n], &z[i], &z[j]), pair_add(v, P.c2[n], &one[n]);
        times(&two[n].at, sigma, &one[n].at), times(&two[n].change, sigma, &one[n].change);
    }
    n = 0;
    EACH(i, 4) for (int j = i; j < 4; j++) for (int k = j; k < 4; k++) for (int l = k; l < 4; l++, n++)
        pair_times(&four[n], &two[of[i][j]], &two[of[k][l]]);
    EACH(i, 4) for (int j = i; j < 4; j++) {
        middle = zero;
        for (int k = j; k < 4; k++) for (int l = k; l < 4; l++, a++) {
            rest = zero, rest.at.c[0] += P.c4[a];
            EACH(b, 10) if (P.c6[a][b]) pair_add(&rest, P.c6[a][b], &two[b]);
            EACH(b, 35) if (P.c8[a][b]) pair_add(&rest, P.c8[a][b], &four[b]);
            pair_times(&t, &two[of[k][l]], &rest), pair_add(&middle, 1, &t);
        }
        pair_times(&t, &one[of[i][j]], &middle), pair_add(v, 1, &t);
    }
}

/* A lower bound of a model, an upper bound of its middle, and how much each variable costs the bound */
typedef struct { real low, middle, part[VARS]; } verdict;
static void judge(const model *g, verdict *out) {
    real along = g->c[5], bend = g->c[square[4][4]], cross = all(0), rest = g->r, top = all(1e-300), high[VARS], share[VARS];
    memset(high, 0, sizeof high), memset(share, 0, sizeof share);
    for (int k = from[3]; k < TERMS; k++) {
        int even = 1;
        EACH(i, VARS) even &= power[k][i] % 2 == 0;
        real c = even ? where(g->c[k] < 0, -g->c[k], all(0)) : size(g->c[k]);
        rest += c;
        EACH(i, VARS) high[i] += power[k][i] * c, share[i] += power[k][i] * (degree_of[k] == ORDER) * size(g->c[k]);
    }
    EACH(i, VARS) top += share[i];
    EACH(i, 4) cross += size(g->c[square[i][4]]);
    mask convex = bend > 0;
    real tip = where(convex, along * along / (4 * bend), all(0)), rounded = (size(along) + cross) * (size(along) + cross) / (4 * bend);
    out->low = all(-INFINITY), out->middle = g->c[0] + g->r;
    EACH(way, 2) { /* 1: over all real w, where the quadratic part is least; 0: over w in [-1, 1], with the cross terms at their worst */
        real c1[4], c2[4][4], part[VARS], edge = where(convex & (size(along) < 2 * bend), -tip, bend - size(along)) - cross;
        real low = g->c[0] + (way ? -tip : edge) - rest * SLACK - 1e-12 * (norm(g, 0) + (way ? rounded : all(0)));
        EACH(i, 4) {
            real ci = g->c[square[i][4]];
            c1[i] = g->c[1 + i] - (way ? along * ci / (2 * bend) : all(0));
            EACH(j, 4) c2[i][j] = g->c[square[i][j]] - (way ? ci * g->c[square[j][4]] / ((i == j ? 4 : 2) * bend) : all(0));
        }
        EACH(i, 4) { /* c1 t + c2 t^2 over [-1, 1] */
            real a = size(c1[i]), b = c2[i][i], worst = where((b > 0) & (a < 2 * b), -a * a / (4 * b), b - a);
            worst = where(worst < 0, worst, all(0));
            part[i] = high[i] + g->r * share[i] / top - worst, low += worst;
        }
        EACH(i, 4) for (int j = i + 1; j < 4; j++) low -= size(c2[i][j]), part[i] += size(c2[i][j]), part[j] += size(c2[i][j]);
        part[4] = high[4] + g->r * share[4] / top + (way ? all(0) : cross + size(along));
        mask better = (way ? convex : ~(mask)all(0)) & ~(out->low >= low);
        out->low = where(better, low, out->low);
        EACH(i, VARS) out->part[i] = where(better, part[i], out->part[i]);
    }
}

typedef struct { double mid[VARS], half[VARS]; int64_t face, depth; } box; /* of sigma, three of y, and w */
typedef struct { double low, high; } span;
static span row_times_y(const box *b, const double row[4]) {
    double mid = row[b->face], radius = 0, sum = fabs(mid);
    EACH(i, 4) if (i != b->face) {
        int n = 1 + i - (i > b->face);
        mid += row[i] * b->mid[n], radius += fabs(row[i]) * b->half[n], sum += fabs(row[i] * b->mid[n]);
    }
    radius = (radius + ROUND * sum) * SLACK;
    return (span){mid - radius, mid + radius};
}
static double least_square(span a) { double m = fmax(fmax(a.low, -a.high), 0); return m * m * (1 - 1e-12); }
static int needless(const box *b, int moves) { /* no state is inside the limits, or, for (B), none has a step that costs less than rho */
    double least = 0, sigma = b->mid[0] - b->half[0];
    EACH(i, 4) {
        double q = least_square(row_times_y(b, P.t[i]));
        least += P.state_cost[i] * q;
        if (P.reach[i] && q * sigma > P.reach[i] * P.reach[i] * SLACK) return 1;
    }
    if (!moves) return 0;
    span u = row_times_y(b, P.gain);
    u.low += b->mid[4] - b->half[4], u.high += b->mid[4] + b->half[4];
    double q = least_square((span){u.low - 1e-9, u.high + 1e-9});
    return q * sigma > P.limit * P.limit * SLACK || P.dt * (least + P.force_cost * q) * sigma * (1 - 1e-12) >= P.rho;
}

typedef struct { model sigma, x[4], force, cost; pair z[4], v, q; } motion;
static void enclose(const box b[LANES], int moves, motion *m) { /* all but V */
    static _Thread_local pair square;
    number(&m->sigma, 0), number(&m->force, 0), number(&m->cost, 0);
    m->sigma.top = m->force.top = 1;
    EACH(i, 4) {
        number(&m->z[i].at, 0), number(&m->z[i].change, 0), number(&m->x[i], 0);
        m->z[i].at.top = 1;
        EACH(l, LANES) if (i == b[l].face) m->z[i].at.c[0][l] = 1; else {
            int n = 1 + i - (i > b[l].face);
            m->z[i].at.c[0][l] = b[l].mid[n], m->z[i].at.c[1 + n][l] = b[l].half[n];
        }
    }
    EACH(l, LANES) {
        m->sigma.c[0][l] = b[l].mid[0], m->sigma.c[1][l] = b[l].half[0];
        m->force.c[0][l] = b[l].mid[4], m->force.c[5][l] = b[l].half[4];
    }
    if (moves) {
        model p, dx[4];
        EACH(i, 4) add(&m->force, &m->force, P.gain[i], &m->z[i].at);
        times(&m->cost, &m->force, &m->force), scale(&m->cost, P.force_cost);
        EACH(i, 4) {
            for (int j = i; j < 4; j++) add(&m->x[i], &m->x[i], P.t[i][j], &m->z[j].at);
            times(&p, &m->x[i], &m->x[i]), add(&m->cost, &m->cost, P.state_cost[i], &p);
        }
        step(&m->sigma, m->x, &m->force, dx);
        for (int i = 3; i >= 0; i--) { /* T is upper triangular */
            for (int j = i + 1; j < 4; j++) add(&dx[i], &dx[i], -P.t[i][j], &m->z[j].change);
            divide(&dx[i], all(P.t[i][i])), m->z[i].change = dx[i];
        }
    }
    number(&m->q.at, 0), number(&m->q.change, 0);
    EACH(i, 4) pair_times(&square, &m->z[i], &m->z[i]), pair_add(&m->q, 1, &square);
}

/* of_v (dt l + V(F) - rho) + of_q (Q(F) - 1), divided by dt sigma. Where this is positive, dt l + V(F) > rho or Q(F) > 1 */
static void beyond(const motion *m, double of_v, double of_q, real low, real high, verdict *out) {
    static _Thread_local model g;
    double least_of = of_v * P.rho + of_q;
    /* 1/sigma lies below its chord, by `sag` in the middle */
    real most = least_of / P.dt / low, least = least_of / P.dt / high, sag = 0.5 * (most + least) - least_of / P.dt / m->sigma.c[0];
    number(&g, 0);
    if (of_v) add(&g, &m->cost, 1, &m->v.change), add(&g, &g, 1 / P.dt, &m->v.at), scale(&g, of_v);
    if (of_q) add(&g, &g, of_q, &m->q.change), add(&g, &g, of_q / P.dt, &m->q.at);
    g.c[0] -= 0.5 * (most + least), g.c[1] += 0.5 * (most - least), g.r += 1e-11 * (most + norm(&g, 0)), g.top = ORDER;
    judge(&g, out);
    out->part[0] += sag;
}
/* What is known of boxes, and which side to halve: where no model is finite, or the middle leans beyond the limit by
   more than 0.02 rad, what makes the lean vary most */
static void choose(const box b[LANES], const verdict *worst, int moves, mask inside, mask done, mask wrong, int *proven, int *refuted,
                   int *axis) {
    EACH(l, LANES) {
        double largest = -1, lean = row_times_y(&b[l], P.t[1]).low / 2 + row_times_y(&b[l], P.t[1]).high / 2;
        int vary = !isfinite(worst->low[l]) || lean * lean * b[l].mid[0] > (P.reach[1] + 0.02) * (P.reach[1] + 0.02);
        double width[VARS] = {b[l].half[0] / b[l].mid[0] / 2, 0, 0, 0, b[l].half[4] / 4e4};
        EACH(i, 4) if (i != b[l].face) {
            int n = 1 + i - (i > b[l].face);
            width[n] = b[l].half[n] * (fabs(P.t[1][i]) + P.dt * fabs(P.t[3][i]) + 1e-3);
        }
        proven[l] = done[l] != 0, refuted[l] = wrong[l] != 0;
        EACH(i, moves ? VARS : 4) {
            double part = vary ? width[i] : worst->part[i][l];
            if (part > largest) largest = part, axis[l] = i;
        }
        double force = b[l].half[4]; /* outside of D little is proven for a wide range of forces */
        if (moves && !inside[l] && force * force * b[l].mid[0] > 4e4) axis[l] = 4;
        force = row_times_y(&b[l], P.gain).low / 2 + row_times_y(&b[l], P.gain).high / 2 + b[l].mid[4];
        if (moves && !vary && force * force * b[l].mid[0] > (P.limit + 5) * (P.limit + 5)) {
            double of_size = fabs(force) * width[0];
            largest = b[l].half[4], axis[l] = 4;
            if (of_size > largest) largest = of_size, axis[l] = 0;
            EACH(i, 4) if (i != b[l].face) {
                int n = 1 + i - (i > b[l].face);
                double part = b[l].half[n] * fabs(P.gain[i]);
                if (part > largest) largest = part, axis[l] = n;
            }
        }
    }
}

/* Of LANES boxes: whether (A) (moves = 0) or (B) is proven, whether it cannot be, and which side to halve. */
static void examine(const box b[LANES], int moves, int *proven, int *refuted, int *axis) {
    static _Thread_local motion m;
    static _Thread_local model g;
    real v_low, v_high, q_low, q_high, l_low, l_high, low = all(0), high = all(0);
    EACH(l, LANES) low[l] = (b[l].mid[0] - b[l].half[0]) * (1 - 1e-12), high[l] = (b[l].mid[0] + b[l].half[0]) * SLACK;
    enclose(b, moves, &m);
    range(&m.q.at, &q_low, &q_high), range(&m.cost, &l_low, &l_high);
    verdict worst, one;
    mask done, wrong = (mask)all(0), inside = q_high * high <= 1;
    if (!moves) {
        value(&m.sigma, m.z, &m.v), judge(&m.v.at, &worst);
        done = (worst.low >= 0) | (q_low * low > 1);
        choose(b, &worst, moves, inside, done, wrong, proven, refuted, axis);
        return;
    }
    double least_force = P.widest; /* of w beyond all boxes: such a step costs too much, or is impossible */
    EACH(j, 4) least_force -= fabs(P.gain[j]);
    double force2 = least_force * least_force * (1 - 1e-12);
    mask bounded = (P.rho / low <= P.dt * P.force_cost * force2) | (force2 * low >= P.limit * P.limit);
    beyond(&m, 0, P.rho, low, high, &one);
    /* far from D, V is a help in small boxes only */
    mask enough = one.low > 0, rough = ~(one.low > -INFINITY);
    rough |= (q_low * low > 1) & (one.middle > 0) & (one.low * low < -0.3 * P.rho / P.dt);
    int all_rough = 1;
    EACH(l, LANES) all_rough &= (enough[l] & bounded[l]) || rough[l];
    if (all_rough) {
        choose(b, &one, moves, inside, enough & bounded, wrong, proven, refuted, axis);
        return;
    }
    value(&m.sigma, m.z, &m.v), range(&m.v.at, &v_low, &v_high);
    EACH(i, 2) { /* V falls beyond Q = 1, so the sum of both may be positive where neither is in all of a box */
        beyond(&m, 1, i ? 2 * P.rho : 0, low, high, &worst);
        mask less = ~(worst.low >= one.low);
        worst.low = where(less, one.low, worst.low), worst.middle = where(one.middle > worst.middle, one.middle, worst.middle);
        EACH(k, VARS) worst.part[k] = where(less, one.part[k], worst.part[k]);
        one = worst;
    }
    enough = worst.low > 0;
    mask every = inside, first = ~(mask)all(0), mixed = ~inside & (q_low * low < 1) & ~(worst.middle >= 0);
    EACH(i, VARS) { /* where neither way holds for all of the box, halve what makes Q vary */
        real part = i ? all(0) : (high - low) / (high + low) * m.q.at.c[0];
        for (int k = 1; k < TERMS; k++) part += power[k][i] * size(m.q.at.c[k]);
        worst.part[i] = where(mixed, part, worst.part[i]);
    }
    EACH(n, P.knots) {
        mask needed = v_low * low < P.until[n], asked = needed & inside & ~enough;
        int any = 0;
        EACH(l, LANES) any |= asked[l] != 0;
        if (!any) continue;
        add(&g, &m.cost, P.a[n], &m.v.change), add(&g, &g, -P.r[n], &m.v.at), judge(&g, &one);
        every &= ~needed | (one.low >= 0);
        wrong |= inside & needed & (v_high * high < P.until[n]) & (one.middle < 0) & ~(worst.middle >= 0);
        mask worse = asked & ~(one.low >= 0) & (first | (one.low < worst.low));
        worst.low = where(worse, one.low, worst.low);
        EACH(i, VARS) worst.part[i] = where(worse, one.part[i], worst.part[i]);
        first &= ~worse;
    }
    done = enough | every | (inside & (P.dt * l_low * (1 - 1e-12) >= v_high));
    real worth = P.rho / low;
    worth = where(inside & (v_high < worth), v_high, worth);
    done &= bounded | (worth <= P.dt * P.force_cost * force2);
    wrong &= ~done & (v_high * high < P.rho) & (P.dt * l_high < v_low);
    wrong &= m.force.c[0] * m.force.c[0] * m.sigma.c[0] < P.limit * P.limit; /* the middle of a box may be beyond the limits */
    EACH(i, 4) if (P.reach[i]) wrong &= m.x[i].c[0] * m.x[i].c[0] * m.sigma.c[0] < P.reach[i] * P.reach[i];
    choose(b, &worst, moves, inside, done, wrong, proven, refuted, axis);
}

void prepare(const problem *given) {
    int n = 0;
    P = *given;
    EACH(d, ORDER + 1) {
        from[d] = n;
        for (int code = 3124; code >= 0; code--) { /* exponents are the digits of a code */
            int e[VARS], sum = 0, rest = code;
            for (int i = VARS - 1; i >= 0; i--) e[i] = rest % 5, sum += e[i], rest /= 5;
            if (sum == d) degree_of[n] = d, memcpy(power[n++], e, sizeof e);
        }
    }
    from[ORDER + 1] = n;
    EACH(i, TERMS) EACH(j, TERMS) EACH(k, TERMS) {
        int same = 1;
        EACH(v, VARS) same &= power[i][v] + power[j][v] == power[k][v];
        if (same) product[i][j] = k;
    }
    EACH(i, VARS) EACH(j, VARS) square[i][j] = product[1 + i][1 + j];
    EACH(f, 2) EACH(k, 5) EACH(j, 16) {
        double v = j < k ? 0 : j % 2 ? -1 : 1;
        for (int i = 1; i <= 2 * j + 1 - f; i++) v /= i;
        EACH(i, k) v *= (j - i) / (i + 1.0);
        series[f][k][j] = v;
    }
}

/* Proves (A) or (B) in a root box. Returns how many boxes are left, 0 if it is proven, and adds to the number of boxes. */
int64_t check(const box *root, int64_t moves, int64_t most_boxes, int64_t *boxes) {
    int64_t filled = 1, room = 1024, failed = 0, done = 0;
    box *stack = malloc(room * sizeof(box)), b[LANES];
    int proven[LANES], refuted[LANES], axis[LANES];
    stack[0] = *root;
    while (filled && !failed && done < most_boxes) {
        int n = 0;
        while (n < LANES && filled) {
            b[n] = stack[--filled], done++;
            n += !needless(&b[n], (int)moves);
        }
        if (!n) continue;
        for (int i = n; i < LANES; i++) b[i] = b[0];
        if (filled + 2 * LANES > room) stack = realloc(stack, (room *= 2) * sizeof(box));
        examine(b, (int)moves, proven, refuted, axis);
        EACH(i, n) if (!proven[i]) {
            failed += refuted[i] || b[i].depth >= 80;
            EACH(side, 2) {
                box half = b[i];
                half.depth++, half.half[axis[i]] /= 2, half.mid[axis[i]] += (side ? 1 : -1) * half.half[axis[i]];
                failed += half.half[axis[i]] < 1e-12 * fabs(half.mid[axis[i]]); /* sums are exact, so halves leave no gap */
                stack[filled++] = half;
            }
        }
    }
    free(stack), *boxes += done;
    return filled + failed;
}

/* For tests: the models of (V(F) - V)/(dt sigma), l/sigma and V/sigma in a box, each with r last, and the exponents. */
void look(const box *root, double *out) {
    static motion m;
    box b[LANES];
    EACH(l, LANES) b[l] = *root;
    enclose(b, 1, &m), value(&m.sigma, m.z, &m.v);
    const model *models[3] = {&m.v.change, &m.cost, &m.v.at};
    EACH(i, 3) {
        EACH(k, TERMS) *out++ = models[i]->c[k][0];
        *out++ = models[i]->r[0];
    }
    EACH(k, TERMS) EACH(i, VARS) *out++ = power[k][i];
}
