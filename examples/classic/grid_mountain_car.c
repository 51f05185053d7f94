/* Gymnasium's mountain car for grid.c.

   The value has two sharp edges: at the goal, which a car reaches with hardly any speed, and at the orbit that touches the wall at
   the left, where all of its speed is lost. So the coordinates are the phase of the car in the valley and the amplitude, the root of
   its energy. Nodes crowd about the two phases at which the car turns and about the amplitude of the wall, and they move with the
   car that no force acts on, so that their values change little from step to step. Every 16 steps they are placed anew. */

#include <math.h>
#include <stdint.h>

enum { ARRIVED = 1, STOPPED };

#define LIMIT 1.0
#define PRICE 0.1
#define NOISE 1e-13
#define CLIFF 1.0 /* between states from which the goal is reached and others */
#define MIRRORED 0

#define GOAL 0.45
#define WALL -1.2
#define POWER 0.0015
#define SLOPE 0.0025                /* acceleration by the steepest slope */
#define DEEP 0.05773502691896258    /* 2 sqrt(SLOPE / 3): the root of twice the height of the hills */
#define EIGHTH 0.7853981633974483   /* of a turn */
#define ENOUGH 0.057383988481676154   /* the amplitude at rest at the goal */
#define AT_WALL 0.6187053884097151       /* the closeness to it at rest at the wall */
#define SQUEEZE 0.3                 /* of the phase: nodes are so much closer where the car turns */
#define NARROW 0.02                 /* width, in closeness, of the band about the wall's orbit in which nodes are close */

static double own(double a, double b) { return (void)a, (void)b, 0; }

/* What Gymnasium's steps conserve is twice the energy, a half step later, and to the next order in the step this. */
static double correction(double a, double v) {
    const double force = SLOPE * cos(3 * a);
    return -0.5 * SLOPE * sin(3 * a) * v * v - force * force / 12;
}

static void chart(double a, double b, double *s, double *r) {
    const double q = DEEP * sin(1.5 * a + EIGHTH), v = b - 0.5 * SLOPE * cos(3 * a);
    const double less = 1 - sqrt(fmax(0.0, q * q + v * v + correction(a, v))) / ENOUGH;
    const double closeness = 1 - copysign(sqrt(fabs(less)), less); /* to the goal's amplitude: 1 there */
    *s = atan2(v / SQUEEZE, q), *r = asinh((closeness - AT_WALL) / NARROW);
}

static void unchart(double s, double r, double *a, double *b) {
    const double along = cos(s), across = SQUEEZE * sin(s), length = sqrt(along * along + across * across);
    const double far = 1 - AT_WALL - NARROW * sinh(r), amplitude = ENOUGH * (1 - far * fabs(far));
    double plain = amplitude; /* without the correction */
    for (int k = 0; k < 6; ++k) {
        *a = (asin(fmax(-1.0, fmin(1.0, plain * along / length / DEEP))) - EIGHTH) / 1.5;
        plain = sqrt(fmax(0.0, amplitude * amplitude - correction(*a, plain * across / length)));
    }
    *b = plain * across / length + 0.5 * SLOPE * cos(3 * *a);
}

/* Free motion over some control steps, forwards or backwards, as if there were no wall. */
static void drift(double *a, double *b, int64_t steps) {
    for (; steps > 0; --steps)
        *b -= SLOPE * cos(3 * *a), *a += *b;
    for (; steps < 0; ++steps)
        *a -= *b, *b += SLOPE * cos(3 * *a);
}

/* States beyond the wall are nodes alone. */
static int moved(double a, double b, double u, double *na, double *nb) {
    if (a >= GOAL) /* a node behind the goal */
        return ARRIVED;
    *nb = fmax(-0.07, fmin(0.07, b + POWER * u - SLOPE * cos(3 * a)));
    *na = fmin(0.6, a + *nb);
    if (*na <= WALL && *nb < 0)
        return STOPPED;
    return *na >= GOAL && *nb >= 0 ? ARRIVED : 0;
}
static void stop(double *a, double *b) { *a = WALL, *b = 0; }

/* Shortly before the goal a value hardly grows along an orbit and fast across it, too fast for a grid. There the least sum of squared
   forces that ends at the goal after n steps is computed directly, for each n: forces are in proportion to what they move. */
#define NEAR 0.36
#define SOON 26
#define CHEAP 0.02
static double direct(double a, double b, int64_t left, double most) {
    if (a < NEAR || b <= 0)
        return most;
    double least = CHEAP;
    const int longest = left < SOON ? (int)left : SOON;
    for (int n = 1; n <= longest; ++n) {
        double u[SOON] = {0}, x[SOON], gain[SOON], cost = 0;
        for (int turn = 0; turn < 3; ++turn) { /* Newton's: the slope's curvature moves the end a little */
            double place = a, speed = b, squared = 0, pushed = 0, to_place = 1, to_speed = 0;
            for (int k = 0; k < n; ++k)
                x[k] = place, speed += POWER * u[k] - SLOPE * cos(3 * place), place += speed;
            for (int k = n - 1; k >= 0; --k) {
                to_speed += to_place; /* what a unit of speed and of place in step k move the end */
                gain[k] = POWER * to_speed, squared += gain[k] * gain[k], pushed += gain[k] * u[k];
                to_place += to_speed * 3 * SLOPE * sin(3 * x[k]);
            }
            const double scale = fmax(0.0, (GOAL - place + pushed) / squared);
            cost = 0;
            for (int k = 0; k < n; ++k)
                u[k] = scale * gain[k], cost += PRICE * u[k] * u[k];
            if (scale == 0 || cost > 1.5 * least)
                break;
        }
        least = fmin(least, cost);
    }
    return least < CHEAP ? least : most;
}
