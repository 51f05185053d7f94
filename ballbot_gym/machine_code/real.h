/* The numbers that generated code computes with: double where DOUBLE is 1, else float. */

#include <math.h>
#include <stdint.h>

#if DOUBLE
typedef double real;
#define real_sqrt sqrt
#define real_fabs fabs
#define real_floor floor
#define SUFFIX ""
#else
typedef float real;
#define real_sqrt sqrtf
#define real_fabs fabsf
#define real_floor floorf
#define SUFFIX "f"
#endif

/* These have names of their own, because GCC would join the sine and the cosine of one angle to a call that is not SIMD. glibc has
   SIMD versions of them, which the attribute makes known. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#if __GLIBC_PREREQ(2, 35)
#define SIMD __attribute__((simd("notinbranch"), const))
#endif
#endif
#ifndef SIMD
#define SIMD __attribute__((const))
#endif
#ifdef __APPLE__
#define NAME(name) __asm__("_" name SUFFIX)
#else
#define NAME(name) __asm__(name SUFFIX)
#endif
SIMD real real_sin(real) NAME("sin");
SIMD real real_cos(real) NAME("cos");
SIMD real real_tan(real) NAME("tan");
SIMD real real_atan(real) NAME("atan");
SIMD real real_acos(real) NAME("acos");
SIMD real real_exp(real) NAME("exp");
SIMD real real_log(real) NAME("log");
SIMD real real_pow(real, real) NAME("pow");
