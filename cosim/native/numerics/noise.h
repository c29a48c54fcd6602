#ifndef COSIM_NOISE_H
#define COSIM_NOISE_H

#include "cosim.h"

/* Gaussian numbers of mean 0 and deviation 1, each from two random words of 64 bits by the
 * transformation of Box and Muller (1958), so that blocks of any length give one sequence. They end
 * at 8.6 deviations, which is 2^-53 of all. */
void cosim_normal(int64_t count, const uint64_t *words, double *y);

#endif
