/* Explicit Runge-Kutta methods by their Butcher tableaus: stages, error norm, step control, dense
 * output. Sums run in a fixed order; of the C library only what is exact is used (sqrt, fabs), so
 * that the bits are the same on every processor.
 *
 * HNW: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed.,
 * Springer 1993. */
#include "runge_kutta.h"
#include "elementary.h"

#include <float.h>
#include <math.h>
#include <string.h>

#define SAFETY 0.9 /* of the step that the error estimate suggests */
#define LEAST_FACTOR 0.2
#define LARGEST_FACTOR 10.0
#define STRETCH 1.01 /* of a step, so that none is left that is far shorter */
#define SPACING 16.0 /* units in the last place of t that a step has at the least */

/* L. Euler, 1768. */
static const double euler_c[] = {0.0, 1.0};
static const double euler_a[] = {1.0};

/* W. Kutta, 1901; HNW table II.1.2. */
static const double rk4_c[] = {0.0, 0.5, 0.5, 1.0, 1.0};
static const double rk4_a[] = {
    0.5,
    0.0, 0.5,
    0.0, 0.0, 1.0,
    1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0,
};

/* P. Bogacki, L. F. Shampine, A 3(2) pair of Runge-Kutta formulas, Appl. Math. Lett. 2(4), 1989. */
static const double rk23_c[] = {0.0, 1.0 / 2.0, 3.0 / 4.0, 1.0};
static const double rk23_a[] = {
    1.0 / 2.0,
    0.0, 3.0 / 4.0,
    2.0 / 9.0, 1.0 / 3.0, 4.0 / 9.0,
};
static const double rk23_e[] = {5.0 / 72.0, -1.0 / 12.0, -1.0 / 9.0, 1.0 / 8.0};

/* J. R. Dormand, P. J. Prince, A family of embedded Runge-Kutta formulae, J. Comp. Appl. Math. 6,
 * 1980; HNW table II.5.2. d: L. F. Shampine, Math. Comp. 46, 1986, as in Hairer's DOPRI5. */
static const double rk45_c[] = {0.0, 1.0 / 5.0, 3.0 / 10.0, 4.0 / 5.0, 8.0 / 9.0, 1.0, 1.0};
static const double rk45_a[] = {
    1.0 / 5.0,
    3.0 / 40.0, 9.0 / 40.0,
    44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0,
    19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0,
    9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0,
    35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0,
};
static const double rk45_e[] = {
    -71.0 / 57600.0, 0.0, 71.0 / 16695.0, -71.0 / 1920.0, 17253.0 / 339200.0, -22.0 / 525.0,
    1.0 / 40.0,
};
static const double rk45_d[] = {
    -12715105075.0 / 11282082432.0, 0.0, 87487479700.0 / 32700410799.0,
    -10690763975.0 / 1880347072.0, 701980252875.0 / 199316789632.0, -1453857185.0 / 822651844.0,
    69997945.0 / 29380423.0,
};

/* HNW section II.5 (the method of order 8, errors of order 5 and 3) and II.6 (dense output of order
 * 7): the numbers of Hairer's DOP853. */
static const double dop853_c[] = {
    0.0, 0.526001519587677318785587544488e-01, 0.789002279381515978178381316732e-01,
    0.118350341907227396726757197510, 0.281649658092772603273242802490,
    0.333333333333333333333333333333, 0.25, 0.307692307692307692307692307692,
    0.651282051282051282051282051282, 0.6, 0.857142857142857142857142857142, 1.0, 1.0, 0.1, 0.2,
    0.777777777777777777777777777778,
};
static const double dop853_a[] = {
    5.26001519587677318785587544488e-2,
    1.97250569845378994544595329183e-2, 5.91751709536136983633785987549e-2,
    2.95875854768068491816892993775e-2, 0.0, 8.87627564304205475450678981324e-2,
    2.41365134159266685502369798665e-1, 0.0, -8.84549479328286085344864962717e-1,
    9.24834003261792003115737966543e-1,
    3.7037037037037037037037037037e-2, 0.0, 0.0, 1.70828608729473871279604482173e-1,
    1.25467687566822425016691814123e-1,
    3.7109375e-2, 0.0, 0.0, 1.70252211019544039314978060272e-1, 6.02165389804559606850219397283e-2,
    -1.7578125e-2,
    3.70920001185047927108779319836e-2, 0.0, 0.0, 1.70383925712239993810214054705e-1,
    1.07262030446373284651809199168e-1, -1.53194377486244017527936158236e-2,
    8.27378916381402288758473766002e-3,
    6.24110958716075717114429577812e-1, 0.0, 0.0, -3.36089262944694129406857109825,
    -8.68219346841726006818189891453e-1, 2.75920996994467083049415600797e1,
    2.01540675504778934086186788979e1, -4.34898841810699588477366255144e1,
    4.77662536438264365890433908527e-1, 0.0, 0.0, -2.48811461997166764192642586468,
    -5.90290826836842996371446475743e-1, 2.12300514481811942347288949897e1,
    1.52792336328824235832596922938e1, -3.32882109689848629194453265587e1,
    -2.03312017085086261358222928593e-2,
    -9.3714243008598732571704021658e-1, 0.0, 0.0, 5.18637242884406370830023853209,
    1.09143734899672957818500254654, -8.14978701074692612513997267357,
    -1.85200656599969598641566180701e1, 2.27394870993505042818970056734e1,
    2.49360555267965238987089396762, -3.0467644718982195003823669022,
    2.27331014751653820792359768449, 0.0, 0.0, -1.05344954667372501984066689879e1,
    -2.00087205822486249909675718444, -1.79589318631187989172765950534e1,
    2.79488845294199600508499808837e1, -2.85899827713502369474065508674,
    -8.87285693353062954433549289258, 1.23605671757943030647266201528e1,
    6.43392746015763530355970484046e-1,
    5.42937341165687622380535766363e-2, 0.0, 0.0, 0.0, 0.0, 4.45031289275240888144113950566,
    1.89151789931450038304281599044, -5.8012039600105847814672114227,
    3.1116436695781989440891606237e-1, -1.52160949662516078556178806805e-1,
    2.01365400804030348374776537501e-1, 4.47106157277725905176885569043e-2,
    5.61675022830479523392909219681e-2, 0.0, 0.0, 0.0, 0.0, 0.0, 2.53500210216624811088794765333e-1,
    -2.46239037470802489917441475441e-1, -1.24191423263816360469010140626e-1,
    1.5329179827876569731206322685e-1, 8.20105229563468988491666602057e-3,
    7.56789766054569976138603589584e-3, -8.298e-3,
    3.18346481635021405060768473261e-2, 0.0, 0.0, 0.0, 0.0, 2.83009096723667755288322961402e-2,
    5.35419883074385676223797384372e-2, -5.49237485713909884646569340306e-2, 0.0, 0.0,
    -1.08347328697249322858509316994e-4, 3.82571090835658412954920192323e-4,
    -3.40465008687404560802977114492e-4, 1.41312443674632500278074618366e-1,
    -4.28896301583791923408573538692e-1, 0.0, 0.0, 0.0, 0.0, -4.69762141536116384314449447206,
    7.68342119606259904184240953878, 4.06898981839711007970213554331,
    3.56727187455281109270669543021e-1, 0.0, 0.0, 0.0, -1.39902416515901462129418009734e-3,
    2.9475147891527723389556272149, -9.15095847217987001081870187138,
};
static const double dop853_e5[] = {
    0.1312004499419488073250102996e-1, 0.0, 0.0, 0.0, 0.0, -0.1225156446376204440720569753e1,
    -0.4957589496572501915214079952, 0.1664377182454986536961530415e1,
    -0.3503288487499736816886487290, 0.3341791187130174790297318841,
    0.8192320648511571246570742613e-1, -0.2235530786388629525884427845e-1, 0.0,
};
static const double dop853_e3[] = {
    5.42937341165687622380535766363e-2 - 0.244094488188976377952755905512, 0.0, 0.0, 0.0, 0.0,
    4.45031289275240888144113950566, 1.89151789931450038304281599044,
    -5.8012039600105847814672114227,
    3.1116436695781989440891606237e-1 - 0.733846688281611857341361741547,
    -1.52160949662516078556178806805e-1, 2.01365400804030348374776537501e-1,
    4.47106157277725905176885569043e-2 - 0.0220588235294117647058823529412, 0.0,
};
static const double dop853_d[] = {
    -0.84289382761090128651353491142e1, 0.0, 0.0, 0.0, 0.0, 0.56671495351937776962531783590,
    -0.30689499459498916912797304727e1, 0.23846676565120698287728149680e1,
    0.21170345824450282767155149946e1, -0.87139158377797299206789907490,
    0.22404374302607882758541771650e1, 0.63157877876946881815570249290,
    -0.88990336451333310820698117400e-1, 0.18148505520854727256656404962e2,
    -0.91946323924783554000451984436e1, -0.44360363875948939664310572000e1,
    0.10427508642579134603413151009e2, 0.0, 0.0, 0.0, 0.0, 0.24228349177525818288430175319e3,
    0.16520045171727028198505394887e3, -0.37454675472269020279518312152e3,
    -0.22113666853125306036270938578e2, 0.77334326684722638389603898808e1,
    -0.30674084731089398182061213626e2, -0.93321305264302278729567221706e1,
    0.15697238121770843886131091075e2, -0.31139403219565177677282850411e2,
    -0.93529243588444783865713862664e1, 0.35816841486394083752465898540e2,
    0.19985053242002433820987653617e2, 0.0, 0.0, 0.0, 0.0, -0.38703730874935176555105901742e3,
    -0.18917813819516756882830838328e3, 0.52780815920542364900561016686e3,
    -0.11573902539959630126141871134e2, 0.68812326946963000169666922661e1,
    -0.10006050966910838403183860980e1, 0.77771377980534432092869265740,
    -0.27782057523535084065932004339e1, -0.60196695231264120758267380846e2,
    0.84320405506677161018159903784e2, 0.11992291136182789328035130030e2,
    -0.25693933462703749003312586129e2, 0.0, 0.0, 0.0, 0.0, -0.15418974869023643374053993627e3,
    -0.23152937917604549567536039109e3, 0.35763911791061412378285349910e3,
    0.93405324183624310003907691704e2, -0.37458323136451633156875139351e2,
    0.10409964950896230045147246184e3, 0.29840293426660503123344363579e2,
    -0.43533456590011143754432175058e2, 0.96324553959188282948394950600e2,
    -0.39177261675615439165231486172e2, -0.14972683625798562581422125276e3,
};
/* Written by code, as a table of pointers would be data that the loader writes to. */
int32_t cosim_method_named(const char *name, cosim_method *method)
{
    const cosim_method euler = {.stages = 1, .c = euler_c, .a = euler_a};
    const cosim_method rk4 = {.stages = 4, .c = rk4_c, .a = rk4_a};
    const cosim_method rk23 = {.stages = 3, .root = 3, .c = rk23_c, .a = rk23_a, .e = rk23_e};
    const cosim_method rk45 = {.stages = 6,
                               .dense = 1,
                               .root = 5,
                               .c = rk45_c,
                               .a = rk45_a,
                               .e = rk45_e,
                               .d = rk45_d};
    const cosim_method dop853 = {.stages = 12,
                                 .extra = 3,
                                 .dense = 4,
                                 .root = 8,
                                 .c = dop853_c,
                                 .a = dop853_a,
                                 .e = dop853_e5,
                                 .e_low = dop853_e3,
                                 .d = dop853_d};
    if (strcmp(name, "euler") == 0)
        *method = euler;
    else if (strcmp(name, "rk4") == 0)
        *method = rk4;
    else if (strcmp(name, "RK23") == 0)
        *method = rk23;
    else if (strcmp(name, "RK45") == 0)
        *method = rk45;
    else if (strcmp(name, "DOP853") == 0)
        *method = dop853;
    else
        return COSIM_NO_VALUE;
    return COSIM_OK;
}

/* The memory: numbers, then vectors of n. */
enum { BEGIN, END, PROPOSED, KNOWN, EXTENDED, NUMBERS };
enum { ATOL, X_BEGIN, X, STAGE, WORK, SLOPES };

int64_t cosim_runge_kutta_memory(const cosim_method *method, int32_t n)
{
    return NUMBERS + (int64_t)(SLOPES + 1 + method->stages + method->extra) * n;
}

static double *vector(const cosim_runge_kutta *s, int32_t which)
{
    return s->memory + NUMBERS + (int64_t)which * s->n;
}

static double *slope(const cosim_runge_kutta *s, int32_t i) { return vector(s, SLOPES + i); }

/* The second where one of both is no number. */
static double larger(double a, double b) { return a > b ? a : b; }
static double smaller(double a, double b) { return a < b ? a : b; }

/* Below so many states a loop over them costs more to begin than it takes. */
enum { FEW = 8 };

static inline void copy(const cosim_runge_kutta *s, double *to, const double *from)
{
    if (s->n >= FEW)
        memcpy(to, from, (size_t)s->n * sizeof *to);
    else
        for (int32_t i = 0; i < s->n; ++i)
            ((volatile double *)to)[i] = from[i]; /* volatile: else it is a call too */
}

static int32_t evaluate(cosim_runge_kutta *s, double t, const double *x, double *dx)
{
    ++s->evaluations;
    return s->f(s->model, t, x, dx);
}

/* sum_j weights_j k_j of one state, j < count; k_j stands `n` behind k_(j-1). */
static inline double weighed(int32_t count, const double *weights, const double *k, int32_t n)
{
    double sum = 0.0;
    for (int32_t j = 0; j < count; ++j, k += n)
        if (weights[j] != 0.0)
            sum += weights[j] * *k;
    return sum;
}

/* out = sum_j weights_j k_j, j < count; of few states or many, the sums run in the same order. */
static void weigh(const cosim_runge_kutta *s, int32_t count, const double *weights, double *out)
{
    if (s->n < FEW) {
        for (int32_t i = 0; i < s->n; ++i)
            out[i] = weighed(count, weights, slope(s, 0) + i, s->n);
        return;
    }
    for (int32_t i = 0; i < s->n; ++i)
        out[i] = 0.0;
    for (int32_t j = 0; j < count; ++j) {
        const double weight = weights[j], *k = slope(s, j);
        if (weight != 0.0)
            for (int32_t i = 0; i < s->n; ++i)
                out[i] += weight * k[i];
    }
}

/* out = x + h sum_j weights_j k_j, j < count, from x at the beginning of the step. */
static inline void combine(const cosim_runge_kutta *s, int32_t count, const double *weights,
                           double h, double *out)
{
    const double *x = vector(s, X_BEGIN), *k = slope(s, 0);
    const int32_t n = s->n;
    if (n >= FEW) {
        weigh(s, count, weights, out);
        for (int32_t j = 0; j < n; ++j)
            out[j] = x[j] + h * out[j];
        return;
    }
    for (int32_t j = 0; j < n; ++j)
        out[j] = x[j] + h * weighed(count, weights, k + j, n);
}

/* The weights of the argument of slope i, which for the last stage is the end of the step. */
static const double *weights_of(const cosim_method *method, int32_t i)
{
    return method->a + i * (i - 1) / 2;
}

/* Slopes `first` to `last`; at the end of the step time is t1 to the last bit. */
static int32_t slopes(cosim_runge_kutta *s, int32_t first, int32_t last, double t1)
{
    const double t0 = s->memory[BEGIN], h = t1 - t0, *c = s->method->c;
    const double *weights = weights_of(s->method, first);
    double *argument = vector(s, STAGE), *k = slope(s, first);
    for (int32_t i = first; i <= last; weights += i++, k += s->n) {
        combine(s, i, weights, h, argument);
        const int32_t status = evaluate(s, c[i] == 1.0 ? t1 : t0 + c[i] * h, argument, k);
        if (status != COSIM_OK)
            return status;
    }
    return COSIM_OK;
}

/* The tolerance of element i, for a step that ends at x1. */
static double tolerance(const cosim_runge_kutta *s, int32_t i, const double *x1)
{
    return vector(s, ATOL)[i] + s->rtol * larger(fabs(vector(s, X_BEGIN)[i]), fabs(x1[i]));
}

/* Sum of squares of v, in units of the tolerance. */
static double squares(const cosim_runge_kutta *s, const double *v, const double *x1)
{
    double sum = 0.0;
    for (int32_t i = 0; i < s->n; ++i) {
        const double scaled = v[i] / tolerance(s, i, x1);
        sum += scaled * scaled;
    }
    return sum;
}

/* The error of a step of length h, in units of the tolerance; 1 is the largest allowed
 * (HNW (II.4.11), of two estimates (II.10.17)). */
static double error_norm(const cosim_runge_kutta *s, double h)
{
    const cosim_method *method = s->method;
    const double *x1 = vector(s, STAGE);
    double *work = vector(s, WORK);
    weigh(s, 1 + method->stages, method->e, work);
    const double sum = squares(s, work, x1);
    if (!method->e_low || sum == 0.0)
        return h * sqrt(sum / s->n);
    weigh(s, 1 + method->stages, method->e_low, work);
    return h * sum / sqrt((sum + 0.01 * squares(s, work, x1)) * s->n);
}

/* A first step within `room`, from the sizes of x, x' and x'' (HNW section II.4). */
static int32_t first_step(cosim_runge_kutta *s, double room, double *h)
{
    const double t = s->memory[BEGIN];
    const double *x = vector(s, X_BEGIN), *k = slope(s, 0);
    double *probe = vector(s, STAGE), *change = slope(s, 1);
    const double d0 = sqrt(squares(s, x, x) / s->n), d1 = sqrt(squares(s, k, x) / s->n);
    const double h0 = smaller(d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1, room);
    for (int32_t i = 0; i < s->n; ++i)
        probe[i] = x[i] + h0 * k[i];
    const int32_t status = evaluate(s, t + h0, probe, change);
    if (status != COSIM_OK)
        return status;
    for (int32_t i = 0; i < s->n; ++i)
        change[i] -= k[i];
    const double d2 = sqrt(squares(s, change, x) / s->n) / h0;
    const double largest = larger(d1, d2);
    const double h1 = largest <= 1e-15 ? larger(1e-6, 1e-3 * h0)
                                       : cosim_pow(100.0 * largest, -1.0 / s->method->root);
    *h = smaller(smaller(100.0 * h0, h1), room);
    return COSIM_OK;
}

/* Find a step to t_end at most whose error is within the tolerance; its end is left in STAGE. */
static int32_t controlled_step(cosim_runge_kutta *s, double t_end, double *t1)
{
    const cosim_method *method = s->method;
    const double t = s->memory[BEGIN], least = larger(SPACING * DBL_EPSILON * fabs(t), DBL_MIN);
    double h = s->memory[PROPOSED];
    if (h == 0.0) {
        const int32_t status = first_step(s, t_end - t, &h);
        if (status != COSIM_OK)
            return status;
    }
    h = larger(h, least);
    for (int32_t rejected = 0;; rejected = 1) {
        if (h < least)
            return COSIM_STEP_TOO_SMALL;
        const int32_t bounded = !(t + STRETCH * h < t_end);
        *t1 = bounded ? t_end : t + h;
        const double taken = *t1 - t;
        const int32_t status = slopes(s, 1, method->stages, *t1);
        if (status != COSIM_OK)
            return status;
        const double error = error_norm(s, taken);
        double factor = LEAST_FACTOR;
        if (error <= DBL_MAX) /* it is a number */
            factor = SAFETY * cosim_pow(larger(error, DBL_MIN), -1.0 / method->root);
        if (error <= 1.0) {
            const double next = taken * smaller(factor, rejected ? 1.0 : LARGEST_FACTOR);
            /* what was not tried because of t_end is still to be tried */
            s->memory[PROPOSED] = bounded && !rejected ? larger(h, next) : next;
            return COSIM_OK;
        }
        h = taken * larger(LEAST_FACTOR, factor);
    }
}

int32_t cosim_runge_kutta_start(void *self, double t, const double *x, const double *nominals)
{
    const cosim_runge_kutta *s = self;
    s->memory[BEGIN] = s->memory[END] = t;
    s->memory[PROPOSED] = s->memory[KNOWN] = s->memory[EXTENDED] = 0.0;
    for (int32_t i = 0; i < s->n; ++i) {
        vector(s, ATOL)[i] = s->rtol * nominals[i];
        vector(s, X_BEGIN)[i] = vector(s, X)[i] = x[i];
    }
    return COSIM_OK;
}

double cosim_runge_kutta_proposed(const cosim_runge_kutta *self) { return self->memory[PROPOSED]; }

int32_t cosim_runge_kutta_step(void *self, double t_end, double *reached)
{
    cosim_runge_kutta *s = self;
    const cosim_method *method = s->method;
    const double t = s->memory[END];
    double *last = slope(s, method->stages), t1 = t_end;
    int32_t status = COSIM_OK;
    *reached = t;
    if (!(t < t_end))
        return COSIM_OK;
    s->memory[BEGIN] = t;
    copy(s, vector(s, X_BEGIN), vector(s, X));
    if (s->memory[KNOWN] != 0.0)
        copy(s, slope(s, 0), last);
    else
        status = evaluate(s, t, vector(s, X_BEGIN), slope(s, 0));
    /* until the step is done: a failure leaves a state from which it can be tried again */
    s->memory[KNOWN] = s->memory[EXTENDED] = 0.0;
    if (status == COSIM_OK && method->root)
        status = controlled_step(s, t_end, &t1);
    else if (status == COSIM_OK) {
        status = slopes(s, 1, method->stages - 1, t1);
        combine(s, method->stages, weights_of(method, method->stages), t1 - t, vector(s, STAGE));
    }
    if (status != COSIM_OK)
        return status;
    copy(s, vector(s, X), vector(s, STAGE));
    s->memory[KNOWN] = method->root != 0;
    s->memory[END] = *reached = t1;
    return COSIM_OK;
}

/* Where the error is not estimated: the end of a shorter step. */
static int32_t shorter_step(cosim_runge_kutta *s, double t, double *x)
{
    const int32_t stages = s->method->stages;
    const int32_t status = slopes(s, 1, stages - 1, t);
    combine(s, stages, weights_of(s->method, stages), t - s->memory[BEGIN], x);
    return status;
}

int32_t cosim_runge_kutta_at(void *self, double t, double *x)
{
    cosim_runge_kutta *s = self;
    const cosim_method *method = s->method;
    const double t0 = s->memory[BEGIN], t1 = s->memory[END], h = t1 - t0;
    const double *x0 = vector(s, X_BEGIN), *x1 = vector(s, X);
    if (t == t1 || t == t0) {
        copy(s, x, t == t1 ? x1 : x0);
        return COSIM_OK;
    }
    if (!method->root)
        return shorter_step(s, t, x);
    const int32_t count = 1 + method->stages + method->extra;
    if (s->memory[EXTENDED] == 0.0) {
        const int32_t status = slopes(s, 1 + method->stages, count - 1, t1);
        if (status != COSIM_OK)
            return status;
        s->memory[EXTENDED] = 1.0;
    }
    /* x0 + p (F_0 + q (F_1 + p (F_2 + q (F_3 + ...)))), p = (t - t0) / h, q = 1 - p: F_0 to F_2
     * make it the cubic with the values and the slopes at both ends (HNW (II.6.7)), F_3 on are
     * h d k */
    const double p = (t - t0) / h, q = 1.0 - p;
    const double *k0 = slope(s, 0), *k1 = slope(s, method->stages);
    double *row = vector(s, WORK);
    for (int32_t i = 0; i < s->n; ++i)
        x[i] = 0.0;
    for (int32_t j = method->dense - 1; j >= 0; --j) {
        weigh(s, count, method->d + j * count, row);
        for (int32_t i = 0; i < s->n; ++i)
            x[i] = (x[i] + h * row[i]) * (j % 2 ? p : q);
    }
    for (int32_t i = 0; i < s->n; ++i) {
        const double change = x1[i] - x0[i], begin = h * k0[i] - change;
        const double end = change - h * k1[i] - begin;
        x[i] = x0[i] + p * (change + q * (begin + p * (end + x[i])));
    }
    return COSIM_OK;
}
