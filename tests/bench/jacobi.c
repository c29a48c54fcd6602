/* Two FMUs of tests/fmi/c/small2.c in a plain loop over their function pointers (Jacobi, zero-order
 * hold), which keeps the inputs and outputs of every step: the floor of bench_coupling.py. */
#include "fmi2Functions.h"

#include <dlfcn.h>
#include <stdlib.h>

enum { U, X = 2, Y = 3, PARTS = 2, KEPT = 3 };

typedef struct {
    fmi2Component instance;
    fmi2SetRealTYPE *set;
    fmi2GetRealTYPE *get;
    fmi2DoStepTYPE *step;
} Part;

static int open_part(Part *part, const char *path, const double values[])
{
    static const fmi2ValueReference parameters[] = {X, 5, 6, 7, 8};
    void *library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    if (!library)
        return 1;
    fmi2InstantiateTYPE *create = dlsym(library, "fmi2Instantiate");
    fmi2ExitInitializationModeTYPE *leave = dlsym(library, "fmi2ExitInitializationMode");
    part->set = dlsym(library, "fmi2SetReal");
    part->get = dlsym(library, "fmi2GetReal");
    part->step = dlsym(library, "fmi2DoStep");
    part->instance = create("part", fmi2CoSimulation, "small", "", NULL, 0, 0);
    return part->set(part->instance, parameters, 5, values) || leave(part->instance);
}

/* Step the pair of `paths` with `values` (x, A, B, C, D each); rows: (steps + 1, 2, 3) for u, x, y,
 * the inputs of row 0 filled. 0: fine. */
int jacobi(const char *const paths[PARTS], const double values[PARTS][5], long steps, double h,
           double *rows)
{
    static const fmi2ValueReference u[] = {U}, outputs[] = {X, Y};
    Part parts[PARTS];
    for (int i = 0; i < PARTS; ++i)
        if (open_part(parts + i, paths[i], values[i]))
            return 1;
    for (long k = 0; k < steps; ++k) {
        const double *before = rows + k * PARTS * KEPT;
        double *row = rows + (k + 1) * PARTS * KEPT;
        for (int i = 0; i < PARTS; ++i) {
            const Part *part = parts + i;
            double *own = row + i * KEPT;
            if (part->set(part->instance, u, 1, before + i * KEPT) ||
                part->step(part->instance, (double)k * h, h, fmi2True) ||
                part->get(part->instance, outputs, 2, own + 1))
                return 1;
        }
        for (int i = 0; i < PARTS; ++i)
            row[i * KEPT] = row[(1 - i) * KEPT + 1];
    }
    return 0;
}
