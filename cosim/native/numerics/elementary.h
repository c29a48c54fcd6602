/* Elementary functions. */
#ifndef COSIM_ELEMENTARY_H
#define COSIM_ELEMENTARY_H

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

#endif
