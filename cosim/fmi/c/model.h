/* The constants of one linear model: x' = A x + B u, y = C x + D u, started at x = X0 + Xu u. Matrices are row-major.
 * Their values are in the generated model.c; nothing here changes during a run, so all instances share it. */
#ifndef MODEL_H
#define MODEL_H

#include <stdint.h>

/* Hidden, so that two of these libraries in one process never see each other's constants. */
#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility push(hidden)
#endif

extern const char *const model_guid;
extern const int32_t model_n, model_m, model_p; /* states, inputs, outputs */
extern const double model_A[], model_B[], model_C[], model_D[], model_X0[], model_Xu[];
extern const int32_t model_is_exact[];   /* (n) the start value of this state may be set */
extern const int32_t model_state_of[];   /* (p) the state that this output is, or -1 */

#include "cosim.h"

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility pop
#endif

#endif
