/* Elementary functions: sums, products, quotients and square roots of doubles alone, which IEEE 754
 * rounds one way, so that every processor and every C library gives the same bits. No fused
 * multiply-add, no rounding mode but to nearest, no state; NaN is always the same NaN.
 *
 * Every function has one form: its argument is brought near a point of a table, exactly; the value
 * at that point is a pair of doubles, an unevaluated sum that is right to 2^-75 or better; what is
 * left is a short Taylor series, small beside that value. The series and the low parts are summed
 * first, the first number of the pair comes last:
 *
 *     result = hi + low,  |low| <= q |result|.
 *
 * The last addition rounds by at most half a unit in the last place (ulp). Each rounding in low is
 * 2^-53 |low| at most, less than q ulp, as an ulp is more than 2^-53 |result|; at most four of them
 * have that size: 0.5 + 4 q ulp in all. Where q would be large, the first term of the series is
 * taken exactly too, into the pair. By that, with what the series leave out:
 *
 *     exp             low: the series times 2^(j/128), q = 0.0028                      0.52 ulp
 *     log             low: r^2/2 beside log c + r, which is exact; q = 0.004           0.52 ulp
 *     sin, cos, tan   low: r^2/2 beside S + C r, exact by 26 bits times 26; q = 0.001  0.51 ulp
 *     atan            low: t^3/3 beside atan c + t, t a pair; q = 0.0001               0.51 ulp
 *     asin, acos      low: d^3/6 beside n pi/64 + d, d a pair; q = 0.0002              0.51 ulp
 *     sinh            low: x^3/6 below 0.3125, q = 0.017; then a difference of pairs   0.57 ulp
 *     tanh            low: x^3/3 below 0.125, q = 0.0053; then a quotient of pairs     0.53 ulp
 *     pow             exp of the pair y log x, whose error is 745 2^-67                0.55 ulp
 *
 * and 3/4 ulp where the result is subnormal: what is rounded to 53 bits is rounded once more. The
 * tests measure these errors against mpmath; 0.52 ulp is the largest that they find.
 *
 * Pairs: with |a| >= |b|, s = a + b rounded, (a - s) + b is the rest exactly (Dekker 1971); for any
 * order Knuth's form needs six operations. Products are split after 26 bits. */
#include "elementary.h"
#include "tables.h"

#include <math.h>
#include <string.h>

#define ROUNDER 0x1.8p52 /* x + ROUNDER - ROUNDER is x rounded to an integer, |x| < 2^51 */

static uint64_t bits_of(double x)
{
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

static double double_of(uint64_t bits)
{
    double x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

static double not_a_number(void) { return double_of(UINT64_C(0x7FF8000000000000)); }
static double infinity(void) { return double_of(UINT64_C(0x7FF0000000000000)); }
static int is_finite(double x) { return x - x == 0.0; }

/* 2^k, -1022 <= k <= 1023 */
static double power_of_two(int32_t k) { return double_of((uint64_t)(k + 1023) << 52); }

/* x without its last `count` bits */
static double without_bits(double x, int count)
{
    return double_of(bits_of(x) & (UINT64_MAX << count));
}

/* a + b, for |a| >= |b| or a = 0 */
static pair ordered_sum(double a, double b)
{
    const double s = a + b;
    return (pair){s, (a - s) + b};
}

static pair sum(double a, double b)
{
    const double s = a + b, rest = s - a;
    return (pair){s, (a - (s - rest)) + (b - rest)};
}

/* a b, right to 2^-104 */
static pair product(double a, double b)
{
    const double p = a * b;
    const double a1 = without_bits(a, 27), a2 = a - a1;
    const double b1 = without_bits(b, 27), b2 = b - b1;
    return (pair){p, ((a1 * b1 - p) + a1 * b2 + a2 * b1) + a2 * b2};
}

/* a / b to 2^-75, with 26 bits first: their product with b is exact */
static pair quotient(pair a, pair b)
{
    const double inverse = 1.0 / b.hi, q = without_bits(a.hi * inverse, 27);
    const double b1 = without_bits(b.hi, 27), b2 = b.hi - b1;
    const double rest = ((a.hi - q * b1) - q * b2) + (a.lo - q * b.lo);
    return (pair){q, rest * inverse};
}

static double with_sign(double magnitude, double x)
{
    return signbit(x) ? -magnitude : magnitude;
}

/* --- exp, sinh, cosh, tanh --- */

/* e^(x + low) = (hi + lo) 2^k with hi + lo in (0.99, 2.01), |x| <= 750, low small beside x; k is
 * returned. x = n ln 2/128 + r, |r| < 0.0028: x - n EXP_HIGH is exact, the rest of r is right to
 * 2^-62; the series ends with r^6/720, so that r^7/5040 < 2^-71 is left out. */
static int32_t exponential(double x, double low, pair *value)
{
    const double n = (x * EXP_PER_X + ROUNDER) - ROUNDER;
    const int32_t steps = (int32_t)n, j = steps & 127;
    const double r = (x - n * EXP_HIGH) + (low - n * EXP_LOW);
    const double square = r * r;
    const double series = r + square * ((1.0 / 2 + r * (1.0 / 6)) +
                                        square * ((1.0 / 24 + r * (1.0 / 120)) +
                                                  square * (1.0 / 720)));
    *value = ordered_sum(POWERS[j].hi, POWERS[j].lo + POWERS[j].hi * series);
    return (steps - j) / 128;
}

/* (hi + lo) 2^k, -1080 <= k <= 1025 */
static double scaled(pair value, int32_t k)
{
    if (k > 1022) /* in two steps, as 2^1024 is no double */
        return (value.hi + value.lo) * power_of_two(1022) * power_of_two(k - 1022);
    if (k > -1022)
        return (value.hi + value.lo) * power_of_two(k);
    const double to_unit = power_of_two(k + 1022);
    const double unit = value.hi * to_unit;
    if (unit + value.lo * to_unit >= 1.0)
        return (value.hi + value.lo) * to_unit * 0x1p-1022;
    /* subnormal, a multiple of 2^-52 in this unit: the addition of 1 rounds to that */
    const pair rounded = ordered_sum(1.0, unit);
    return ((rounded.hi + (rounded.lo + value.lo * to_unit)) - 1.0) * 0x1p-1022;
}

double cosim_exp(double x)
{
    if (isnan(x))
        return not_a_number();
    if (x > 710.0)
        return infinity();
    if (x < -746.0)
        return 0.0;
    pair value;
    const int32_t k = exponential(x, 0.0, &value);
    return scaled(value, k);
}

/* e^x as a pair of its true size, |x| <= 45 */
static pair exponential_pair(double x)
{
    pair value;
    const double size = power_of_two(exponential(x, 0.0, &value));
    return (pair){value.hi * size, value.lo * size};
}

/* e^|x| / 2 where e^-|x| is nothing beside it */
static double half_exponential(double magnitude)
{
    if (magnitude > 711.0)
        return infinity();
    pair value;
    const int32_t k = exponential(magnitude, 0.0, &value);
    return scaled(value, k - 1);
}

double cosim_sinh(double x)
{
    const double a = fabs(x);
    if (isnan(x))
        return not_a_number();
    if (a < 0x1p-28)
        return x;
    if (a < 0.3125) {
        const double s = x * x;
        const double series =
            1.0 / 6 +
            s * (1.0 / 120 +
                 s * (1.0 / 5040 +
                      s * (1.0 / 362880 +
                           s * (1.0 / 39916800 + s * (1.0 / 6227020800 +
                                                      s * (1.0 / 1307674368000))))));
        return x + x * s * series;
    }
    if (a > 22.0)
        return with_sign(half_exponential(a), x);
    const pair up = exponential_pair(a), down = exponential_pair(-a);
    const pair s = ordered_sum(up.hi, -down.hi);
    return with_sign(0.5 * (s.hi + (s.lo + (up.lo - down.lo))), x);
}

double cosim_cosh(double x)
{
    const double a = fabs(x);
    if (isnan(x))
        return not_a_number();
    if (a > 22.0)
        return half_exponential(a);
    const pair up = exponential_pair(a), down = exponential_pair(-a);
    const pair s = ordered_sum(up.hi, down.hi);
    return 0.5 * (s.hi + (s.lo + (up.lo + down.lo)));
}

double cosim_tanh(double x)
{
    const double a = fabs(x);
    if (isnan(x))
        return not_a_number();
    if (a < 0x1p-28)
        return x;
    if (a < 0.125) {
        const double s = x * x;
        const double series =
            -1.0 / 3 +
            s * (2.0 / 15 +
                 s * (-17.0 / 315 +
                      s * (62.0 / 2835 +
                           s * (-1382.0 / 155925 +
                                s * (21844.0 / 6081075 +
                                     s * (-929569.0 / 638512875 +
                                          s * (6404582.0 / 10854718875)))))));
        return x + x * s * series;
    }
    if (a > 22.0)
        return with_sign(1.0, x);
    const pair e = exponential_pair(2.0 * a);
    const pair above = sum(e.hi, -1.0), below = sum(e.hi, 1.0);
    const pair ratio =
        quotient(ordered_sum(above.hi, above.lo + e.lo), ordered_sum(below.hi, below.lo + e.lo));
    return with_sign(ratio.hi + ratio.lo, x);
}

/* --- log, pow --- */

/* x = 2^k z, z of [0.705, 1.41) in an interval around c with 1/c of ten bits; z/c - 1 = r1 + r2
 * exactly, |r1 + r2| < 0.0059; log x = hi + r + lo + log(1 + r) - r with hi = k ln 2 + log c, a
 * multiple of 2^-42. Around 1 the interval has c = 1 and hi = lo = 0. */
typedef struct {
    double hi, lo, r1, r2;
} log_parts;

static log_parts parts_of_log(double x)
{
    int32_t k = 0;
    if (x < 0x1p-1022) {
        x *= 0x1p52;
        k = -52;
    }
    const uint64_t first = UINT64_C(0x3FE6900000000000), bits = bits_of(x);
    const uint64_t above = bits - first + (UINT64_C(1024) << 52); /* never negative */
    const int32_t exponent = (int32_t)(above >> 52) - 1024;
    const interval *c = &LOGARITHMS[(above >> 45) & 127];
    const double z = double_of(bits - ((uint64_t)exponent << 52));
    k += exponent;
    const double z1 = without_bits(z, 10);
    return (log_parts){
        k * LN2_HIGH + c->hi,
        k * LN2_LOW + c->lo,
        z1 * c->inverse - 1.0,
        (z - z1) * c->inverse,
    };
}

/* (log(1 + r) - r + r^2/2) / r^3; r^11/11 and on are less than 2^-63 r */
static double log_series(double r)
{
    const double s = r * r;
    return (1.0 / 3 - r * (1.0 / 4)) +
           s * ((1.0 / 5 - r * (1.0 / 6)) + s * ((1.0 / 7 - r * (1.0 / 8)) + s * (1.0 / 9)));
}

double cosim_ln(double x)
{
    if (isnan(x) || x < 0.0)
        return not_a_number();
    if (x == 0.0)
        return -infinity();
    if (!is_finite(x))
        return x;
    const log_parts p = parts_of_log(x);
    const pair r = sum(p.r1, p.r2);
    const pair s = sum(p.hi, r.hi);
    const double series = r.hi * r.hi * (r.hi * log_series(r.hi) - 0.5);
    return s.hi + (s.lo + ((p.lo + r.lo) + (series - r.hi * r.lo)));
}

/* log x to 2^-67 of its size: r and r^2/2 are exact, r^3/3 is below 2^-23 */
static pair log_pair(double x)
{
    const log_parts p = parts_of_log(x);
    const pair r = sum(p.r1, p.r2);
    const pair square = product(r.hi, r.hi);
    const pair linear = sum(p.hi, r.hi);
    const pair quadratic = sum(linear.hi, -0.5 * square.hi);
    const double cubic = r.hi * square.hi * log_series(r.hi);
    const double small = (r.lo - (0.5 * square.lo + r.hi * r.lo)) + p.lo;
    return ordered_sum(quadratic.hi, quadratic.lo + (linear.lo + (small + cubic)));
}

/* 0: no integer, 1: odd, 2: even */
static int parity(double y)
{
    const double a = fabs(y);
    if (a >= 0x1p53)
        return 2;
    const uint64_t whole = (uint64_t)a;
    return (double)whole != a ? 0 : (whole & 1 ? 1 : 2);
}

/* The cases of C11 F.10.4.4 where a number is zero or infinite, or the power out of range. */
static double extreme_power(int is_large, double sign)
{
    return is_large ? sign * infinity() : sign * 0.0;
}

double cosim_pow(double x, double y)
{
    if (x == 1.0 || y == 0.0)
        return 1.0;
    if (isnan(x) || isnan(y))
        return not_a_number();
    if (y == 2.0)
        return x * x; /* rounded once */
    const double a = fabs(x);
    const int whole = parity(y);
    const double sign = signbit(x) && whole == 1 ? -1.0 : 1.0;
    if (a == 0.0 || !is_finite(a))
        return extreme_power((a == 0.0) == (y < 0.0), sign);
    if (fabs(y) >= 0x1p64) /* |log a| is 2^-53 at least, where it is not 0 */
        return a == 1.0 ? 1.0 : extreme_power((a > 1.0) == (y > 0.0), 1.0);
    if (x < 0.0 && whole == 0)
        return not_a_number();
    const pair logarithm = log_pair(a);
    const pair exponent = product(logarithm.hi, y);
    if (exponent.hi > 710.0 || exponent.hi < -746.0)
        return extreme_power(exponent.hi > 0.0, sign);
    pair value;
    const int32_t k = exponential(exponent.hi, exponent.lo + logarithm.lo * y, &value);
    return sign * scaled(value, k);
}

/* --- sin, cos, tan --- */

/* The window of 256 bits of 1/(2 pi) that begins at `offset`, as eight words, the highest first. */
static void window(int32_t offset, uint32_t *words)
{
    const int32_t first = offset / 32, shift = offset % 32;
    for (int32_t i = 0; i < 8; ++i) {
        const uint64_t two = (uint64_t)TURN[first + i] << 32 | TURN[first + i + 1];
        words[i] = (uint32_t)(two >> (32 - shift));
    }
}

/* frac = frac times `factor`, of which whole turns are dropped */
static void multiply_turns(const uint32_t *frac, uint32_t factor, uint32_t *result)
{
    uint64_t carry = 0;
    for (int32_t i = 7; i >= 0; --i) {
        carry += (uint64_t)frac[i] * factor;
        result[i] = (uint32_t)carry;
        carry >>= 32;
    }
}

/* x = n pi/64 + r for |x| >= 2^15 (Payne and Hanek 1983). x = m 2^e with an integer m of 53 bits;
 * the bits of 1/(2 pi) above 2^-e make whole turns with m and are left out; 256 bits from there
 * on, times m, are the fraction of a turn to 2^-203. No double is nearer to a multiple of pi/64
 * than 2^-62 of it, 2^-69 turns, as the continued fractions of all exponents show (the worst is
 * 6381956970095103 2^792): r is right to 2^-105, by its pair. */
static int32_t reduce_large(double x, pair *r)
{
    const uint64_t bits = bits_of(x);
    const int32_t e = (int32_t)(bits >> 52 & 2047) - 1075;
    const uint64_t m = (bits & (UINT64_MAX >> 12)) | UINT64_C(1) << 52;
    uint32_t words[8], upper[8], turns[8];
    window(e + 64, words);
    multiply_turns(words, (uint32_t)(m >> 32), upper);
    multiply_turns(words, (uint32_t)m, turns);
    uint64_t carry = 0;
    for (int32_t i = 7; i >= 0; --i) { /* upper is a word higher */
        carry += (uint64_t)turns[i] + (i < 7 ? upper[i + 1] : 0);
        turns[i] = (uint32_t)carry;
        carry >>= 32;
    }
    const int32_t n = (int32_t)((turns[0] >> 24) + 1) >> 1; /* the nearest of 128 */
    const int is_below = (int)(turns[0] >> 24 & 1);         /* r is negative: n was rounded up */
    turns[0] &= 0x1FFFFFF;
    if (is_below) {
        uint64_t borrow = 1; /* two's complement, of 249 bits */
        for (int32_t i = 7; i >= 0; --i) {
            borrow += (uint32_t)~turns[i];
            turns[i] = (uint32_t)borrow;
            borrow >>= 32;
        }
        turns[0] &= 0x1FFFFFF;
    }
    pair fraction = {0.0, 0.0};
    for (int32_t i = 7; i >= 0; --i) {
        const pair s = sum(turns[i] * power_of_two(7 - 32 * (i + 1)), fraction.hi);
        fraction = ordered_sum(s.hi, s.lo + fraction.lo);
    }
    const pair scaled_turns = product(fraction.hi, SIN_UNIT);
    const double low = scaled_turns.lo + (fraction.hi * SIN_UNIT_LOW + fraction.lo * SIN_UNIT);
    const double sign = (is_below ? -1.0 : 1.0) * (signbit(x) ? -1.0 : 1.0);
    *r = (pair){sign * scaled_turns.hi, sign * low};
    return signbit(x) ? -n : n;
}

/* x = n pi/64 + r, |r| < 0.0246; n modulo 128 is returned. pi/64 is a sum of three parts of 33 bits
 * and a rest, n has 20 bits: the three products are exact, the rest is right to 2^-140. */
static int32_t reduce(double x, pair *r)
{
    if (fabs(x) >= 0x1p15)
        return reduce_large(x, r);
    const double n = (x * SIN_PER_X + ROUNDER) - ROUNDER;
    const pair first = sum(x - n * SIN_PART_1, -(n * SIN_PART_2));
    const pair second = sum(first.hi, -(n * SIN_PART_3));
    *r = ordered_sum(second.hi, first.lo + second.lo - n * SIN_PART_4);
    return (int32_t)n;
}

/* sin(n pi/64 + r) = S cos r + C sin r; S and C have 26 bits and a rest, r1 too: C r1 is exact. */
static pair sine(int32_t n, pair r)
{
    const pair S = SINES[n & 127], C = SINES[(n + 32) & 127];
    const double r1 = without_bits(r.hi, 27), r2 = (r.hi - r1) + r.lo;
    const double s = r.hi * r.hi;
    const double odd = r.hi * s * (-1.0 / 6 + s * (1.0 / 120 + s * (-1.0 / 5040)));
    const double even =
        s * (-1.0 / 2 + s * (1.0 / 24 + s * (-1.0 / 720 + s * (1.0 / 40320))));
    const pair linear = ordered_sum(S.hi, C.hi * r1);
    const double from_sine = S.lo + (S.hi + S.lo) * even;
    const double from_cosine = C.hi * r2 + (C.lo * r.hi + (C.hi + C.lo) * odd);
    return (pair){linear.hi, linear.lo + (from_sine + from_cosine)};
}

double cosim_sin(double x)
{
    if (!is_finite(x))
        return not_a_number();
    if (fabs(x) < 0x1p-27)
        return x;
    pair r;
    const int32_t n = reduce(x, &r);
    const pair y = sine(n, r);
    return y.hi + y.lo;
}

double cosim_cos(double x)
{
    if (!is_finite(x))
        return not_a_number();
    pair r;
    const int32_t n = reduce(x, &r);
    const pair y = sine(n + 32, r);
    return y.hi + y.lo;
}

double cosim_tan(double x)
{
    if (!is_finite(x))
        return not_a_number();
    if (fabs(x) < 0x1p-27)
        return x;
    pair r;
    const int32_t n = reduce(x, &r);
    const pair s = sine(n, r), c = sine(n + 32, r);
    const pair ratio = quotient(ordered_sum(s.hi, s.lo), ordered_sum(c.hi, c.lo));
    return ratio.hi + ratio.lo;
}

/* --- atan --- */

/* atan(a / b), 0 <= a <= b, b > 0, where b or a is 1. With c = i/64 nearest to a/b it is
 * atan c + atan t, t = (a - c b)/(b + c a), |t| < 1/127. c has seven bits and b1 45: c b1 is exact,
 * and so is a minus it. */
static pair arc(double a, double b, double ratio)
{
    const double i = (ratio * 64.0 + ROUNDER) - ROUNDER, c = i / 64.0;
    const pair angle = ANGLES[(int32_t)i];
    const double b1 = without_bits(b, 8);
    const pair above = sum(a - c * b1, -(c * (b - b1)));
    const pair t = quotient(above, ordered_sum(b, c * a));
    const double whole = t.hi + t.lo, s = whole * whole;
    const double series = -1.0 / 3 + s * (1.0 / 5 + s * (-1.0 / 7 + s * (1.0 / 9)));
    const pair linear = ordered_sum(angle.hi, t.hi);
    return ordered_sum(linear.hi, linear.lo + (angle.lo + (t.lo + whole * s * series)));
}

/* whole - y */
static pair complement(double hi, double lo, pair y)
{
    const pair s = ordered_sum(hi, -y.hi);
    return (pair){s.hi, s.lo + (lo - y.lo)};
}

double cosim_atan(double x)
{
    if (isnan(x))
        return not_a_number();
    const double a = fabs(x);
    if (a < 0x1p-28)
        return x;
    if (a >= 0x1p56) /* 1/x is nothing beside pi/2 */
        return with_sign(HALF_PI_HIGH, x);
    const pair y =
        a <= 1.0 ? arc(a, 1.0, a) : complement(HALF_PI_HIGH, HALF_PI_LOW, arc(1.0, a, 1.0 / a));
    return with_sign(y.hi + y.lo, x);
}

/* --- asin, acos --- */

/* sqrt(1 - x^2), 0 <= x <= 1: 1 - x^2 is right to 2^-105, and to 2^-52 of itself at least */
static pair other_leg(double x)
{
    const double x1 = without_bits(x, 27), x2 = x - x1;
    const pair first = sum(1.0, -(x1 * x1));
    const pair rest = sum(first.hi, -2.0 * x1 * x2);
    const pair square = ordered_sum(rest.hi, rest.lo + (first.lo - x2 * x2));
    if (square.hi == 0.0)
        return (pair){0.0, 0.0};
    const double root = sqrt(square.hi), inverse = 0.5 / root;
    const double r1 = without_bits(root, 27), r2 = root - r1;
    const double error = ((square.hi - r1 * r1) - 2.0 * r1 * r2) - r2 * r2;
    return (pair){root, (error + square.lo) * inverse};
}

/* The angle of the first quadrant with this sine y and cosine x. With n pi/64 next to it, S its
 * sine and C its cosine, it is n pi/64 + asin d, d = y C - x S, |d| < 0.027. The products of 26
 * bits each are exact. */
static pair angle_of(pair y, pair x)
{
    const double m = y.hi < x.hi ? y.hi : x.hi, m2 = m * m;
    const double angle = m + m * m2 * (1.0 / 6 + m2 * (0.075 + m2 * 0.085)); /* to 0.002 */
    const double nearest = (angle * SIN_PER_X + ROUNDER) - ROUNDER;
    const double n = y.hi < x.hi ? nearest : 32.0 - nearest;
    const pair S = SINES[(int32_t)n], C = SINES[(int32_t)n + 32];
    const double y1 = without_bits(y.hi, 27), x1 = without_bits(x.hi, 27);
    const double y2 = (y.hi - y1) + y.lo, x2 = (x.hi - x1) + x.lo;
    const pair d = sum(y1 * C.hi, -(x1 * S.hi));
    const double low =
        d.lo + ((y2 * C.hi - x2 * S.hi) + (y.hi * C.lo - x.hi * S.lo));
    const double whole = d.hi + low, s = whole * whole;
    const double series =
        1.0 / 6 +
        s * (3.0 / 40 + s * (5.0 / 112 + s * (35.0 / 1152 + s * (63.0 / 2816))));
    const pair linear = ordered_sum(n * SIN_PART_1, d.hi);
    const double rest = n * (SIN_PART_2 + SIN_PART_3);
    return ordered_sum(linear.hi, linear.lo + (rest + (low + whole * s * series)));
}

double cosim_asin(double x)
{
    const double a = fabs(x);
    if (isnan(x) || a > 1.0)
        return not_a_number();
    if (a < 0x1p-28)
        return x;
    const pair y = angle_of((pair){a, 0.0}, other_leg(a));
    return with_sign(y.hi + y.lo, x);
}

double cosim_acos(double x)
{
    const double a = fabs(x);
    if (isnan(x) || a > 1.0)
        return not_a_number();
    pair y = angle_of(other_leg(a), (pair){a, 0.0});
    if (x < 0.0)
        y = complement(PI_HIGH, PI_LOW, y);
    return y.hi + y.lo;
}
