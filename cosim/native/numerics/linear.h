/* Linear algebra in a fixed order, and linear systems that step. */
#ifndef COSIM_LINEAR_H
#define COSIM_LINEAR_H

#include "cosim.h"

/* The place of `count` doubles in `memory`, behind those before, of which there are `next`. Without
 * memory it only counts. */
double *cosim_place(double *memory, int64_t *next, int64_t count);

/* Note a part of a memory, its first double and how many, as pair `next` of `parts`; returns the
 * number of the next pair. */
int64_t cosim_note_part(int64_t begin, int64_t count, int64_t *parts, int64_t next);

/* y = M v (set) or y += M v (add), M of shape (rows, columns). */
void cosim_multiply(int32_t rows, int32_t columns, const double *M, const double *v, double *y);
void cosim_multiply_add(int32_t rows, int32_t columns, const double *M, const double *v, double *y);

/* The inverse of M, shape (n, n), which is overwritten, by elimination with partial pivoting. */
int32_t cosim_invert(int32_t n, double *M, double *inverse);

/* E = exp(M) for M of shape (n, n), by scaling, a Taylor series and squaring; `work` has 2 n n
 * doubles. */
void cosim_exponential(int32_t n, const double *M, double *E, double *work);

/* y(t) = c' exp(G t) beta at `count` instants, for G of shape (n, n); `work` has 4 n n doubles. */
void cosim_response(int32_t n, const double *G, const double *c, const double *beta, int64_t count,
                    const double *t, double *y, double *work);

/* exp([[M, S], [0, M]]) = [[E, F], [0, E]]: F is the derivative of E = exp(M) in the direction S
 * (C. Van Loan, IEEE Trans. Automatic Control, 1978). All of shape (n, n); `work` has 4 n n
 * doubles. */
void cosim_exponential_slope(int32_t n, const double *M, const double *S, double *E, double *F,
                             double *work);

/* cosim_exponential_slope of so many numbers, side by side: one alone waits for each division. */
#define COSIM_NUMBERS 4
void cosim_exponential_numbers(const double *M, const double *S, double *E, double *F);

/* G = G0 + sum_j theta_j G1_j, all of shape (n, n), those of G1 one behind the other. */
void cosim_system_matrix(int32_t n, int32_t count, const double *G0, const double *G1,
                         const double *theta, double *G);

/* Exact discretization of x' = A x + B u for inputs that are interpolated linearly over the step
 * (the triangle, or first-order, hold): x(t+h) = Ad x + B0 u(t) + B1 u(t+h). held[j] != 0:
 * zero-order hold of input j at u(t). `work` has 4 N N doubles, N = n + 2 m. */
void cosim_first_order_hold(int32_t n, int32_t m, const double *A, const double *B, double h,
                            const uint8_t *held, double *Ad, double *B0, double *B1, double *work);
/* The same for `count` steps of lengths h, one result behind the other. */
void cosim_first_order_holds(int64_t count, int32_t n, int32_t m, const double *A, const double *B,
                             const double *h, const uint8_t *held, double *Ad, double *B0,
                             double *B1, double *work);

/* The discretization for steps of another length than the others. */
typedef struct {
    double h; /* [s] */
    const double *Ad, *B0, *B1;
} cosim_linear_substep;

/* What to discretize for steps of any length. */
typedef struct {
    const double *A, *B; /* (n, n), (n, m) */
    const uint8_t *held; /* (m) */
    double step;         /* length of a communication step [s] */
    double h;            /* what the following are for [s]; 0: for nothing yet */
    double *Ad, *B0, *B1, *work;
} cosim_linear_dynamics;

typedef struct {
    int32_t n, m, p;                    /* states, inputs, outputs */
    const double *Ad, *B0, *B1, *C, *D; /* (n, n), (n, m), (n, m), (p, n), (p, m) */
    double *memory;                     /* x, then n doubles of scratch */
    const cosim_linear_substep *substeps; /* (n_substeps), parts of a communication step */
    int32_t n_substeps;
    cosim_linear_dynamics *dynamics; /* NULL: there are no other steps */
} cosim_linear;
int32_t cosim_linear_step(void *self, double t0, double t1, double h, const double *u0,
                          const double *u1, double *y);
int32_t cosim_linear_outputs(void *self, double t, const double *u, double *y);

/* y(t) = u(t - steps h); memory: the row that is due now, then `steps` rows of `width`. */
typedef struct {
    int32_t steps, width;
    double *memory;
} cosim_delay;
int32_t cosim_delay_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y);

#endif
