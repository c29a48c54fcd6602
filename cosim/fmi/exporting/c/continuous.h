/* The numbers of a linear model; matrices are row-major. */
#ifndef CONTINUOUS_H
#define CONTINUOUS_H

#include "model.h"

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility push(hidden)
#endif

extern const double model_A[], model_B[], model_C[], model_D[], model_Xu[];
extern const uint8_t model_free[]; /* (m) zeros: no input is held inside a step */

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility pop
#endif

#endif
