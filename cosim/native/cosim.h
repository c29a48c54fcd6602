/* The native step: one C signature for everything that advances over communication steps.
 *
 * A step function advances its component from t0 to t1 (h seconds apart), with inputs u0 at t0 and
 * u1 at t1, and writes the outputs at t1. What it needs stands behind `self`: constants, and one
 * flat `memory` of doubles that holds the whole state, so that saving and restoring a component is
 * one copy. Arrays are row-major. No allocation, no globals, no input or output.
 *
 * Every sum runs in a fixed order and every file is compiled with -ffp-contract=off: the same
 * arithmetic gives the same bits in the package and in an exported FMU. */
#ifndef COSIM_H
#define COSIM_H

#include <stdint.h>

/* No value: the one NaN, so that equal runs have equal bits. */
static inline double cosim_no_value(void)
{
    const union {
        uint64_t bits;
        double value;
    } nothing = {UINT64_C(0x7FF8000000000000)};
    return nothing.value;
}

#define COSIM_OK 0
#define COSIM_NO_VALUE 1 /* an input that was needed carries no value (NaN) */
#define COSIM_STEP_TOO_SMALL 2 /* the tolerance needs a step below the spacing of numbers */
#define COSIM_SINGULAR 3 /* a matrix has no inverse */
#define COSIM_NOT_CONVERGED 4 /* an iteration has not reached its end */
#define COSIM_FULL 5 /* there is no room for more samples */
#define COSIM_OUTSIDE 6 /* a sample is said to be of an instant outside its communication step */

typedef int32_t (*cosim_step)(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

/* Advance one component over `steps` communication steps: times t[0..steps], inputs u (one row a
 * time, `u_stride` doubles apart), outputs y (one row a step, `y_stride` doubles apart). Returns
 * the number of steps completed; *status says why it stopped early. */
int64_t cosim_cascade(cosim_step step, void *self, int64_t steps, const double *t, double h,
                      const double *u, int64_t u_stride, double *y, int64_t y_stride,
                      int32_t *status);

/* --- linear.c --- */

/* The place of `count` doubles in `memory`, behind those before, of which there are `next`. Without
 * memory it only counts. */
double *cosim_place(double *memory, int64_t *next, int64_t count);

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

typedef struct {
    int32_t n, m, p;                    /* states, inputs, outputs */
    const double *Ad, *B0, *B1, *C, *D; /* (n, n), (n, m), (n, m), (p, n), (p, m) */
    double *memory;                     /* x, then n doubles of scratch */
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

/* --- static.c --- */

/* Functions of the inputs at the same instant, element by element of y, of `width` elements.
 *
 * y = u within two limits. */
void cosim_limit(int32_t width, double lower, double upper, const double *u, double *y);
/* `count` inputs multiplied; y is divided by those that `divides` names. It is not defined where one
 * of these is 0: there it refuses. */
void cosim_product(int32_t count, int32_t width, const int32_t *divides, const double *u,
                   double *y);
int32_t cosim_product_refuses(int32_t count, int32_t width, const int32_t *divides,
                              const double *u);
/* u1 or u2: the inputs are both and control, u1 counts where control >= threshold. */
void cosim_switch(int32_t width, double threshold, const double *u, double *y);

/* --- window.c --- */

/* A discretized linear system, and weighted sums of the increments of other signals over the last
 * `taps` steps. The increment over a step is Jx x(t) + J0 u(t) + J1 u(t+h). Outputs: those of the
 * system, then the sums, which have no value (NaN) before `taps` steps were taken. */
typedef struct {
    cosim_linear linear;        /* its memory begins that of the whole */
    int32_t taps, width;        /* at least 1 */
    const double *Jx, *J0, *J1; /* (width, n), (width, m), (width, m) */
    const double *weights;      /* (taps) the oldest first */
    /* that of the system, number of steps taken, the newest increment without J1 u(t+h) (width),
     * ring (taps, width) */
    double *memory;
} cosim_window;
void cosim_window_outputs(const cosim_window *self, const double *u, double *y);
int32_t cosim_window_step(void *self, double t0, double t1, double h, const double *u0,
                          const double *u1, double *y);

/* --- control.c --- */

/* x' = u, except where x is at a limit and u points outwards: exact for inputs that are straight
 * lines. y = x; memory: x. */
typedef struct {
    int32_t width;
    double lower, upper;
    const uint8_t *held; /* (width) zero-order hold of this input at the start of the step */
    double *memory;
} cosim_integrator;
int32_t cosim_integrator_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

/* A PID controller of the setpoint r = u[0] and the measurement z = u[1], after Astrom and Hagglund
 * (2006), with its outputs y and I:
 *     v = gain (setpoint_weight r - z) + I + D,   y = v within its limits,
 *     I' = integral_gain (r - z) + tracking_rate (y - v),
 *     D = d - w,   w' = filter_rate (d - w),   d = derivative_gain (derivative_weight r - z). */
typedef struct {
    double gain, integral_gain, derivative_gain;
    double setpoint_weight, derivative_weight;
    double filter_rate, tracking_rate; /* tracking_rate 0: there are no limits */
    double lower, upper;
    double initial_integral;
    const uint8_t *held; /* (2) zero-order hold of this input at the start of the step */
    double *memory;      /* I, w */
} cosim_pid;
void cosim_pid_start(const cosim_pid *self, const double *u);
void cosim_pid_outputs(const cosim_pid *self, const double *u, double *y);
int32_t cosim_pid_step(void *self, double t0, double t1, double h, const double *u0,
                       const double *u1, double *y);
/* The same of a digital controller: I and w by Euler's methods from sample to sample, forward for I
 * and backward for w, the inputs those at the start of the step. */
int32_t cosim_sampled_pid_step(void *self, double t0, double t1, double h, const double *u0,
                               const double *u1, double *y);

/* --- elementary.c --- */

/* As in C11 annex F, right to less than 0.6 units in the last place (0.75 where the result is
 * subnormal), with the same bits on every machine that rounds as IEEE 754 says. */
double cosim_sin(double x);
double cosim_cos(double x);
double cosim_tan(double x);
double cosim_asin(double x);
double cosim_acos(double x);
double cosim_atan(double x);
double cosim_sinh(double x);
double cosim_cosh(double x);
double cosim_tanh(double x);
double cosim_exp(double x);
double cosim_ln(double x);
double cosim_pow(double x, double y);

/* --- noise.c --- */

/* Gaussian numbers of mean 0 and deviation 1, each from two random words of 64 bits by the
 * transformation of Box and Muller (1958), so that blocks of any length give one sequence. They end
 * at 8.6 deviations, which is 2^-53 of all. */
void cosim_normal(int64_t count, const uint64_t *words, double *y);

/* --- runge_kutta.c --- */

/* dx = f(t, x); 0: fine. Its own failures are negative: they end the call that needed it. */
typedef int32_t (*cosim_right_hand_side)(void *model, double t, const double *x, double *dx);

/* An explicit Runge-Kutta method with `stages` stages. Of its 1 + stages + extra slopes
 *     k_i = f(t + c_i h, x + h sum_j a_ij k_j),   j < i,
 * slope `stages` is the one at the end of the step, so that its row of a are the weights of the
 * step; the extra ones serve the dense output alone. */
typedef struct {
    int32_t stages, extra;
    int32_t dense;       /* rows of d */
    int32_t root;        /* the error of a step grows with h^root; 0: it is not estimated */
    const double *c;     /* (1 + stages + extra) */
    const double *a;     /* rows 1, 2, ... one behind the other, row i of i numbers */
    const double *e;     /* (1 + stages) error = h sum e_j k_j */
    const double *e_low; /* (1 + stages) of a second estimate of lower order; NULL: there is none */
    const double *d;     /* (dense, 1 + stages + extra) */
} cosim_method;
/* Write euler, rk4, RK23, RK45 or DOP853; COSIM_NO_VALUE: there is no such method. */
int32_t cosim_method_named(const char *name, cosim_method *method);

/* x' = f(t, x), integrated step by step. */
typedef struct {
    const cosim_method *method;
    cosim_right_hand_side f;
    void *model;
    int32_t n;           /* of states, at least 1 */
    double rtol;         /* not used where the method does not estimate its error */
    int64_t evaluations; /* of f, so far */
    double *memory;      /* its whole state */
} cosim_runge_kutta;
/* The number of doubles of `memory`. */
int64_t cosim_runge_kutta_memory(const cosim_method *method, int32_t n);
/* Begin at t with x; the absolute tolerance of a state is rtol times its nominal value. */
int32_t cosim_runge_kutta_start(void *self, double t, const double *x, const double *nominals);
/* Take one step, to t_end at most, and without an estimate of the error to t_end: f is evaluated at
 * no time beyond it. After a failure the step can be tried again. */
int32_t cosim_runge_kutta_step(void *self, double t_end, double *reached);
/* x at a time within the last step. The first call may evaluate f; without an estimate of the error
 * each does, for x is that of a shorter step. */
int32_t cosim_runge_kutta_at(void *self, double t, double *x);

/* --- expression.c --- */

/* An expression in t as a postfix program; see expression.py for the language. */
typedef struct {
    int32_t length;
    const int32_t *code;     /* operation, or number of operations + index of a constant */
    const double *constants; /* referred to by code */
} cosim_program;
#define COSIM_STACK 64
double cosim_evaluate(const cosim_program *program, double t);

typedef struct {
    int32_t count;
    const cosim_program *programs;
} cosim_expression;
int32_t cosim_expression_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

/* --- alphas.c --- */

/* Known factors alpha of a disturbance (4): expressions in t, or signals. */
typedef struct {
    int32_t count, signals;        /* alphas; elements of the input that the signals are */
    const int32_t *element;        /* (count) of that input; -1: an expression */
    const cosim_program *programs; /* (count) */
} cosim_alphas;
void cosim_alphas_at(const cosim_alphas *self, double t, const double *signals, double *values);

/* The same at instants before now; those of signals by linear interpolation between samples. */
typedef struct {
    cosim_alphas alphas;
    int32_t rows;         /* instants */
    int32_t depth;        /* samples that are kept */
    const double *age;    /* (rows) how long before now expressions are read [s] */
    const int32_t *steps; /* (count, rows) how many communication steps signals are */
    const double *part;   /* (count, rows) and what part of one, less than 1 */
} cosim_past_alphas;
/* The number of doubles of `ring`, the samples before now. */
int64_t cosim_past_alphas_memory(const cosim_past_alphas *self);
/* values (count, rows) at t, which `now` samples were before, where the signals are `signals`; no
 * value (NaN) where the past is not long enough. */
void cosim_past_alphas_at(const cosim_past_alphas *self, const double *ring, int64_t now, double t,
                          const double *signals, double *values);
void cosim_past_alphas_keep(const cosim_past_alphas *self, double *ring, int64_t now,
                            const double *signals);

/* --- estimate.c --- */

/* The products mu of (21)-(25): mu_c = sign_c delta(t - D_row) prod alpha_b(t - D_i). Its inputs are
 * delta, and the signals among the alphas. */
typedef struct {
    /* delays, q + 1, alpha factors of one term */
    int32_t rows, terms, factors;
    const int32_t *steps;            /* (rows) delays in communication steps */
    const cosim_past_alphas *alphas; /* the distinct ones, one a group, at t - D_j */
    const int32_t *row;              /* (terms) row of delta */
    const int32_t *factor;           /* (terms, factors) group * rows + row */
    const double *sign;              /* (terms) */
    /* number of samples before now, ring of the longest delay, (groups, rows) of scratch, ring of
     * the alphas */
    double *memory;
} cosim_regressor;
int32_t cosim_regressor_step(void *self, double t0, double t1, double h, const double *u0,
                             const double *u1, double *y);
void cosim_regressor_outputs(const cosim_regressor *self, double t, const double *u, double *y);

/* How theta of one group follows from the estimates: the recurrence
 * sum_k c_k f(t - D - k spacing) = 0. */
#define COSIM_EXPONENTIAL 1  /* V = 1: one exponential */
#define COSIM_EXPONENTIALS 2 /* V = 2: two exponentials, the larger parameter first */
#define COSIM_SINE 3         /* V = 2: one sine */
#define COSIM_DAMPED_SINE 4  /* V = 2: one damped sine, decay and rate */
#define COSIM_T_EXPONENTIAL 5 /* V = 2: one t exp, a double root */
typedef struct {
    int32_t kind;
    int32_t index[3]; /* which chi; 0 is the normalizer */
    int32_t theta[2]; /* where the results belong */
    double sign[3];
    double spacing; /* [s] */
} cosim_recovery;

/* Least squares (33)-(34) in information form: R'R = prior + integral of m m' dt, accumulated by
 * Givens rotations. */
typedef struct {
    int32_t unknowns, groups, parameters, held;
    double start; /* [s] */
    double prior; /* square root of 1 / P0; 0: none */
    const cosim_recovery *recovery;
    double *memory; /* R (q+1, q+1), then q + 1 of scratch */
} cosim_least_squares;
int32_t cosim_least_squares_step(void *self, double t0, double t1, double h, const double *u0,
                                 const double *u1, double *y);
void cosim_least_squares_start(cosim_least_squares *self, double *y);

/* theta of one group from eta; no value (NaN) where there is none. */
void cosim_recover(const cosim_recovery *recovery, const double *eta, double *theta);

/* --- adaptive.c --- */

/* Adaptive laws for the linear regression p = m'eta (26), normalized so that the unit of mu does not
 * matter; inputs and outputs are those of least squares. */
typedef struct {
    int32_t unknowns, groups, parameters, held;
    double start;      /* [s] */
    double gain;       /* [1/s] */
    double forgetting; /* time constant in which samples lose their weight [s]; of DREM */
    const cosim_recovery *recovery;
    double *memory;
} cosim_adaptive;
/* The gradient: eta' = gain m (p - m'eta) / m'm, from eta = 0. */
int64_t cosim_gradient_memory(const cosim_adaptive *self);
int32_t cosim_gradient_step(void *self, double t0, double t1, double h, const double *u0,
                            const double *u1, double *y);
/* Dynamic regressor extension and mixing (S. Aranovskiy, A. Bobtsov, R. Ortega, A. Pyrkin, IEEE
 * Trans. Automatic Control, 2017) with Kreisselmeier's extension. */
int64_t cosim_drem_memory(const cosim_adaptive *self);
int32_t cosim_drem_step(void *self, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y);

/* --- householder.c --- */

/* Rotate `rows` rows of n numbers, which are overwritten, into the upper triangular R of shape
 * (n, n): afterwards R'R has grown by the products of the rows. `work` has n doubles. */
void cosim_householder(int32_t n, double *R, int32_t rows, double *block, double *work);
/* Solve R x = b for the upper triangular R (n, n), whose rows are `stride` doubles apart. */
void cosim_solve_upper(int32_t n, int32_t stride, const double *R, const double *b,
                       int32_t b_stride, double *x);
/* The inverse of R'R; `work` has n (n + 1) doubles. */
void cosim_covariance(int32_t n, int32_t stride, const double *R, double *covariance, double *work);

/* --- output_error.c --- */

/* Of a model that is fitted, and so of its components, each of which has a column. */
#define COSIM_MOST_COLUMNS 48
#define COSIM_MOST_PARAMETERS 16

/* The outputs of a linear plant under a disturbance of the class (4)-(5), as a regression:
 *     x' = A x + sum_i B_i alpha_i f_i,   y = C x + sum_i D_i alpha_i f_i + offset,
 *     f_i = c_i' expm(G_i t) beta_i,      G_i = G0_i + sum_j theta_ij G1_ij,
 * linear in beta_i = beta_i(0), x(0) and the offset. The disturbance is a straight line between
 * samples. */
typedef struct {
    int32_t states, outputs, components;
    int32_t sources;       /* known factors alpha, each with its B and D */
    int32_t offset;        /* whether a constant on every output is unknown */
    int32_t ar;            /* order of the filter that whitens the noise */
    int32_t average;       /* steps, the mean of whose samples is one row; more than 1 without ar */
    const int32_t *size;   /* (components) V_i */
    const int32_t *count;  /* (components) parameters in theta_i */
    const int32_t *source; /* (components) which of them each has */
    const double *c;       /* c_i one behind the other */
    const double *G0, *G1; /* G0_i, and G1_i1, G1_i2, ..., each (V_i, V_i) */
    const double *step;    /* (intervals) length of an interval between samples [s] */
    const double *Ad;      /* (intervals, states, states) */
    const double *B0, *B1; /* (intervals, sources, states) for both ends of the interval */
    const double *K;       /* (intervals, states, outputs) gain of the predictor, in Ad, B0 */
    const double *L;       /* (intervals, outputs, outputs) lower triangle: L e has the covariance of
                            * the noise, where e is what is predicted wrong at the interval's end */
    const double *C;       /* (outputs, states) */
    const double *D;       /* (sources, outputs) */
    const double *W;       /* (outputs, outputs) makes the noise of the outputs white */
    const double *a;       /* (outputs, ar) W e is white, e(k) = v(k) - a_1 v(k-1) - ..., v = y - fit */
    const int32_t *every;  /* (outputs) samples from one value to the next that `a` is for */
    double forgetting;     /* weight of the square of a row over that of the next sample; 1: the same */
} cosim_output_error;

/* Samples between those of the grid, in the order of time. The row of an output is (C, D0, D1): it
 * is C x + D0 d0 + D1 d1, with the state at the beginning of the step and the disturbances at both
 * ends. */
typedef struct {
    int64_t count;
    double *place;    /* (count) sample of the grid at the end of the step */
    double *rows;     /* (count, outputs, states + 2 sources) */
    double *residual; /* (count, outputs) as that of the grid */
} cosim_between_record;

typedef struct {
    int64_t first, end;      /* samples of the window */
    const double *residual;  /* (samples, outputs) y less its known part; NaN: not measured */
    const double *alpha;     /* (samples, sources) */
    const int32_t *interval; /* (samples) which one ends at the sample; NULL: 0 for all */
    const cosim_between_record *between; /* NULL: none; only without ar and K */
} cosim_record;

/* What the outputs would be without disturbance, from x(0) = 0: with the gain K of a predictor,
 *     x' = Ad x + B0 u0 + B1 u1 + K y,   y = C x + D u,   B0 less K D. */
typedef struct {
    int32_t inputs;
    const double *B0, *B1;   /* (intervals, states, inputs) */
    const double *D;         /* (outputs, inputs) */
    const uint8_t *predicts; /* (intervals) whether K is used: there is a y */
} cosim_known_input;
/* y less that, for samples begin..end-1; x: the state at sample begin - 1, and as much scratch. */
void cosim_output_error_residual(const cosim_output_error *self, const cosim_known_input *known,
                                 int64_t begin, int64_t end, const double *u, const double *y,
                                 const int32_t *interval, double *x, double *residual);

/* E_i = expm(G_i h) of all components, and F_ij, their derivatives by theta, one behind the other;
 * `work` has 6 V V doubles for the largest V. */
void cosim_output_error_basis(const cosim_output_error *self, const double *theta, double h,
                              double *E, double *F, double *work);

/* A pass over samples makes the upper triangle R of [basis, x(0), offset, d basis/d theta, residual]
 * at the beginning of `work`. `start` begins at the first sample of a window, `take` goes on. */
int64_t cosim_output_error_memory(const cosim_output_error *self);
int32_t cosim_output_error_columns(const cosim_output_error *self);
void cosim_output_error_start(const cosim_output_error *self, const double *theta, double *work);
void cosim_output_error_take(const cosim_output_error *self, const double *theta,
                             const cosim_record *record, int64_t begin, int64_t end, double *work);
/* The products of the outputs' residuals, (outputs, outputs), summed over the window, at theta and the
 * linear unknowns; `work` is used. */
void cosim_output_error_products(const cosim_output_error *self, const double *theta,
                                 const double *unknowns, const cosim_record *record, double *work,
                                 double *products);
/* The rows of every sample of the window, (samples, outputs, columns), neither filtered nor weighed. */
void cosim_output_error_rows(const cosim_output_error *self, const double *theta,
                             const cosim_record *record, double *work, double *rows);

/* What became of a parameter. */
#define COSIM_ESTIMATED 0
#define COSIM_FIXED 1     /* its bounds are equal */
#define COSIM_ABSENT 2    /* noise alone explains its component */
#define COSIM_DEPENDENT 3 /* other parameters have the same effect */
#define COSIM_AT_BOUND 4

typedef struct {
    const cosim_output_error *model;
    cosim_record record;
    double *work;       /* cosim_output_error_memory doubles */
    double *amplitudes; /* beta, x(0), offset */
} cosim_experiment;

/* Variable projection: the linear unknowns of every experiment are eliminated by orthogonal
 * rotations, theta is found by Gauss-Newton on what remains (G. Golub and V. Pereyra, SIAM J.
 * Numerical Analysis, 1973; L. Kaufman, BIT, 1975). */
typedef struct {
    int32_t experiments, components, parameters;
    int32_t most_iterations, iterations;
    const cosim_experiment *experiment;
    const int32_t *count;        /* (components) */
    const double *lower, *upper; /* (parameters) */
    const double *scale;         /* (parameters) longest step */
    const double *threshold;     /* (components) statistic from which on it is no noise */
    double accuracy;             /* of a row: what is smaller is rounding */
    double tolerance;            /* of update, in units of the step that is small enough */
    double most_squares;         /* predicted after a few steps; a fit with more is given up */
    double *theta;               /* (parameters) where the regression is linearized */
    double *estimate;            /* (parameters) */
    double *covariance;          /* (parameters, parameters) of the estimate */
    double *statistics;          /* (components) beta' C^-1 beta, C of unit variance */
    uint8_t *state;              /* (parameters) */
    double variance;             /* of a row */
    double freedom;              /* rows less unknowns */
} cosim_fit;
/* Iterate from theta to the least squares. The last step moves the linear unknowns to first order. */
int32_t cosim_output_error_fit(cosim_fit *self);
/* Pass over all samples at the estimate: the linear unknowns, the variance and R are then those there. */
void cosim_output_error_settle(cosim_fit *self);
/* One step with the R that is there, for samples that were taken since. */
int32_t cosim_output_error_update(cosim_fit *self);

/* --- weights.c --- */

/* C = L L', row by row, into the lower triangle of L; returns whether there is one. */
int32_t cosim_factorize(int32_t n, const double *C, double *L);

/* W with W C W' = I for the covariance C of noise, (n, n); `deviations` are those of C. None is taken
 * for smaller than `least`, nor for as good as equal to others. C is changed, L is scratch. */
void cosim_noise_weights(int32_t n, double *covariance, const double *least, double *deviations,
                         double *L, double *W);

/* --- predictor.c --- */

/* The Kalman filter without process noise of x' = T x, y = C x + noise of covariance R, for instants at
 * any distances and with outputs that are missing at some. */
typedef struct {
    int32_t states, outputs;
    const double *T; /* (intervals, states, states) */
    const double *C; /* (outputs, states) */
    const double *R; /* (outputs, outputs) */
} cosim_predictor;
/* One sample: K and L as below, and P, that of x there, becomes that of x at the next one, to which T
 * leads; NULL: there is none, and K is 0. */
int32_t cosim_predictor_gain(const cosim_predictor *self, const uint8_t *measured, const double *T,
                             double *P, double *K, double *L, int32_t *there, double *work);
/* For each of `count` samples its gain K (states, outputs), by which y there corrects x at the next one,
 * and L (outputs, outputs) as in cosim_output_error. `interval` ends at the sample, P (states, states)
 * is the covariance of x at the first one; `there` has outputs numbers of scratch, `work` outputs
 * (3 outputs + states) + states^2. COSIM_NO_VALUE: a covariance that is none. */
int32_t cosim_predictor_gains(const cosim_predictor *self, int64_t count, const int32_t *interval,
                              const uint8_t *measured, double *P, double *K, double *L,
                              int32_t *there, double *work);

/* --- rayleigh.c --- */

#define COSIM_MOST_TERMS 128
#define COSIM_MOST_ROWS 48 /* delays: one more than there are basis functions, all groups together */

/* The regression (25) as a function of theta: mu' chi(theta) = 0, with noise of covariance N in mu. */
typedef struct {
    int32_t components, parameters, rows, groups, terms;
    const int32_t *size, *count; /* (components) */
    const int32_t *group;        /* (components) which group b it belongs to */
    const double *c, *G0, *G1;   /* as in cosim_output_error */
    const double *delays;        /* (rows) D_j [s] */
    const int32_t *parts;        /* (terms, rows - 1) the rows R_b of all groups */
    const double *lower, *upper; /* (parameters) of the grid of starts, and of theta */
    int32_t points;              /* of the grid in every direction */
} cosim_rayleigh;
/* Minimize chi' R'R chi / chi' N chi from theta; R, N of shape (terms, terms). */
int32_t cosim_rayleigh_minimize(const cosim_rayleigh *self, const double *R, const double *N,
                                double *theta, double *value);
/* The same from the best points of the grid. */
int32_t cosim_rayleigh_search(const cosim_rayleigh *self, const double *R, const double *N,
                              double *theta, double *value);

/* --- start_grid.c --- */

#define COSIM_MOST_STARTS 16

/* Starts of theta from y alone. The model has, for every component, one component for each point of
 * a grid of its theta, without parameters: one pass over the samples makes the R of all of them, and
 * a combination of points is then a choice of columns. Where these are too many to try each, one
 * component after the other is added at its best point, then points are chosen anew two by two. */
typedef struct {
    int32_t components;
    int32_t beside; /* whether the last point of each component is that of a fit, beside the grid */
    const cosim_output_error *model;
    const int32_t *size, *count; /* (components) V_i of one point, and parameters */
    const int32_t *points;       /* (components) */
    const int32_t *alike;        /* (components) last one before that is interchangeable with it; -1 */
    const uint8_t *even;         /* (parameters) whether the negative makes the same signals */
    const double *theta;         /* (points_i, count_i) of one component behind the other */
} cosim_start_grid;
/* The number of doubles of `memory` for so many records. */
int64_t cosim_start_grid_memory(const cosim_start_grid *self, int32_t records);
/* Insert a value among the smallest ones of a grid, which stand in ascending order with their points;
 * infinity and NaN are none. Returns how many there are then, at most `most`. */
int32_t cosim_keep_smallest(double value, int64_t point, int32_t found, int32_t most, double *values,
                            int64_t *points);
/* The number of combinations of points; 0: too many to try each. */
int64_t cosim_start_grid_points(const cosim_start_grid *self);
/* The least squares of every combination, where each can be tried, summed over records; R: those of
 * the model, (records, columns, columns). */
void cosim_start_grid_squares(const cosim_start_grid *self, int32_t records, const double *R,
                              double *memory, double *squares);
/* The combinations that no neighbor betters, the best first, at most `most` of them: theta of shape
 * (most, parameters). Returns how many there are. */
int32_t cosim_start_grid_search(const cosim_start_grid *self, int32_t records, const double *R,
                                double *memory, int32_t most, double *theta);

/* Starts beside a fit whose theta are the last points: points of one component or of two that no
 * neighbor betters, the others as they are there. They lead to optima that a part of the signal tells
 * apart, which the distance of points of the other parts would hide. */
int32_t cosim_start_grid_beside(const cosim_start_grid *self, const double *R, double *memory,
                                int32_t most, double *theta);

/* Of all theta of the same model the one that is reported: even parameters positive, interchangeable
 * components by their last parameter, the largest first. */
void cosim_start_grid_order(const cosim_start_grid *self, double *theta);

/* --- between.c --- */

/* A plant whose outputs are sampled between communication points, where its inputs are straight
 * lines: x' = A x + B v, y = C x + D v, with v = (u, disturbances). */
typedef struct {
    int32_t most; /* samples in one step */
    int32_t states, outputs, inputs, components;
    int64_t capacity;      /* samples */
    const double *A, *B;   /* (states, states), (states, inputs + components) */
    const double *C, *D;   /* (outputs, states), (outputs, inputs + components) */
    const uint8_t *held;   /* (inputs + components) zero-order hold over the step */
} cosim_between;
int64_t cosim_between_memory(const cosim_between *self);
/* The record that stands in its memory. */
cosim_between_record cosim_between_in(const cosim_between *self, double *memory, int64_t count);
/* Append the samples of the step from t0 to t1, which the sample `place` of the grid ends; x: the
 * state at t0 without disturbances. `samples` are (outputs, most) values, then `most` instants, NaN
 * where there is none. One at t1, or without an instant, is that of the grid: y becomes it, or NaN. */
int32_t cosim_between_take(const cosim_between *self, int64_t place, double t0, double t1,
                           const double *x, const double *u0, const double *u1,
                           const double *samples, cosim_between_record *record, double *y);

/* --- kalman.c --- */

/* The covariance R'R of n states, R not necessarily triangular, over a step and a measurement. */
/* R'R becomes Phi R'R Phi' + sum q q' over the rows q of `noise`, R triangular. `work` has
 * (n + rows) n + n doubles. */
void cosim_kalman_predict(int32_t n, const double *Phi, int32_t rows, const double *noise, double *R,
                          double *work);
/* Take y = row'x + noise of this variance, where `innovation` is y less row'x, after J. Potter
 * (G. Bierman, Factorization Methods, 1977). `work` has 2 n doubles. */
void cosim_kalman_correct(int32_t n, const double *row, double variance, double innovation, double *x,
                          double *R, double *work);
double cosim_kalman_variance(int32_t n, const double *R, int32_t state);

/* The extended Kalman filter of x, the basis beta(t) and theta: inputs mu, which is not used, the
 * signals among the alphas, y and u, of which a step takes those at its beginning; outputs theta and
 * its standard errors. Over a step
 * the transition is exact at the present theta, its derivative that of the exact one. */
typedef struct {
    int32_t terms;                   /* of mu */
    const cosim_output_error *model; /* of one interval, without a predictor */
    const cosim_known_input *known;
    const cosim_alphas *alphas;      /* of the components */
    double deviation;                /* of the noise of the outputs, made white */
    double size;                     /* deviation of x and beta at first */
    const double *theta, *spread;    /* (parameters) at first, and its deviation */
    const double *threshold;         /* (components) statistic from which on it is no noise */
    double *memory;
} cosim_extended_kalman;
int64_t cosim_extended_kalman_memory(const cosim_extended_kalman *self);
void cosim_extended_kalman_start(cosim_extended_kalman *self, double *y);
int32_t cosim_extended_kalman_step(void *self, double t0, double t1, double h, const double *u0,
                                   const double *u1, double *y);

/* --- identifier.c --- */

/* A predictor in some modes w alone, x = V w, for samples that may be missing. */
typedef struct {
    cosim_predictor modes; /* of one interval */
    const double *V;       /* (states, modes) */
    const double *P;       /* (modes, modes) at the first sample */
} cosim_mode_predictor;

/* Output error online: every `period` samples theta is estimated from all of them, or from those of
 * a moving window. A start is searched on a grid by y itself, and, once mu counts, by the Rayleigh
 * quotient and improved on delta. The search is repeated when the samples have become so many more,
 * and the best of all fits counts, so that no local minimum stays for long. Its inputs
 * are mu, the signals among the alphas, delta, y and u, of which a step takes those at its beginning;
 * its outputs are theta, its standard errors, the deviation of the noise of each y, and the amplitudes at the beginning of the
 * window. Where the noise of several y is not known, its covariance is that of the residual, and
 * estimated again with every fit to all samples: at least as often as they have become twice as many.
 * Where y is sampled at instants of its own, the samples stand between y and u in the inputs, and
 * count in the place of y.
 * Without on_y it ends with what was found on delta, its outputs are theta and the amplitudes;
 * without on_delta too with the quotient, its inputs are mu and the signals and its output theta. */
typedef struct {
    int32_t period;
    int32_t width;    /* of the outputs */
    int32_t average;  /* samples of mu that make one row */
    int32_t weighs;   /* whether W is estimated, of several outputs; else it is that of on_y */
    int32_t disturbances; /* elements of delta */
    int64_t window;   /* samples; 0: all */
    int64_t capacity; /* samples */
    double start;     /* first instant of which mu counts [s] */
    double settled;   /* first instant of which delta counts [s] */
    const cosim_regressor *products;
    const cosim_past_alphas *lagging; /* those of the components, as late as delta; one row */
    const cosim_rayleigh *rayleigh;
    const cosim_output_error *on_delta, *on_y; /* NULL: not fitted */
    const cosim_known_input *known;            /* of on_y */
    const double *lower, *upper, *scale; /* (parameters) as in cosim_fit */
    const double *threshold;             /* (components) */
    const double *deviations;            /* (outputs) of the noise that the W of on_y makes white */
    const cosim_start_grid *grid;
    const cosim_between *between; /* NULL: y is sampled at the communication points */
    /* of y whose samples, of communication points alone, may be missing; NULL: its gain is K of on_y */
    const cosim_mode_predictor *predictor;
    double *memory;
} cosim_identifier;
/* The number of doubles of `memory`, and of those before the samples, which are only appended. */
int64_t cosim_identifier_memory(const cosim_identifier *self);
int64_t cosim_identifier_state(const cosim_identifier *self);
void cosim_identifier_start(cosim_identifier *self, double *y);
int32_t cosim_identifier_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

/* --- augmented_kalman.c --- */

/* The Kalman filter of x, delta and its derivative, which is a random walk: inputs mu, which is not
 * used, the signals among the alphas, y and u, of which a step takes those at its beginning; output
 * theta. Whenever the samples are
 * a tenth more, and at the last of the run, delta is smoothed over all of them, and theta is what the
 * projection makes of it; between, theta stays. */
typedef struct {
    int32_t terms, signals;                      /* of mu, among the alphas */
    int32_t states, inputs, outputs, parameters; /* states: x, delta, its derivative */
    int64_t capacity;                            /* samples */
    const double *Phi, *B0, *B1; /* (states, states), (states, inputs) for both ends of a step */
    const double *C, *D, *W;     /* (outputs, states), (outputs, inputs), made white by W */
    const double *noise;         /* (2, states) rows whose products are the covariance of a step */
    const double *first_spread;  /* (states) deviations at first */
    double deviation;            /* of the noise of the outputs, made white */
    const cosim_identifier *projection; /* on delta, its products have a memory of their own; or NULL */
    double *memory;
} cosim_augmented_kalman;
int64_t cosim_augmented_kalman_memory(const cosim_augmented_kalman *self);
/* Smooth over all samples; delta of each. */
void cosim_augmented_kalman_smooth(const cosim_augmented_kalman *self, double *delta);
void cosim_augmented_kalman_start(cosim_augmented_kalman *self, double *y);
int32_t cosim_augmented_kalman_step(void *self, double t0, double t1, double h, const double *u0,
                                    const double *u1, double *y);

#endif
