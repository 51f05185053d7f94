/* Gymnasium's pendulum for grid.c: the coordinates are its angle and its rate, and an episode ends with its time. */

#include <math.h>
#include <stdint.h>

enum { ARRIVED = 1, STOPPED };

#define LIMIT 2.0
#define PRICE 0.001
#define NOISE 1e-7
#define CLIFF INFINITY
#define MIRRORED 1

static double own(double a, double b) {
    const double turn = 6.283185307179586, angle = a - turn * floor((a + turn / 2) / turn);
    return angle * angle + 0.1 * b * b;
}
static void chart(double a, double b, double *s, double *r) { *s = a, *r = b; }
static void unchart(double s, double r, double *a, double *b) { *a = s, *b = r; }
static void drift(double *a, double *b, int64_t steps) { (void)a, (void)b, (void)steps; }
static int moved(double a, double b, double u, double *na, double *nb) {
    *nb = fmax(-8.0, fmin(8.0, b + (15.0 * sin(a) + 3.0 * u) * 0.05));
    *na = a + *nb * 0.05;
    return 0;
}
static void stop(double *a, double *b) { *a = *b = 0; }
static double direct(double a, double b, int64_t left, double most) { return (void)a, (void)b, (void)left, most; }
