/* What the C programs of the benchmark have in common: time, errors, and the result that they print
 * (drivers/protocol.py). */
#ifndef PROGRAM_H
#define PROGRAM_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static void fail(const char *what)
{
    fprintf(stderr, "%s\n", what);
    exit(1);
}

/* Processor time of the process [s]. */
static double now(void)
{
    struct timespec time;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
    return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

/* Print the time, and column `first` and every `distance`th behind it of some rows; the numbers of
 * the rows stand in `samples` with commas. */
static void report(double seconds, char *samples, const double *rows, size_t width, size_t first,
                   size_t distance)
{
    const char *separator = "";
    printf("measured: {\"seconds\": %.9f, \"samples\": [", seconds);
    for (char *sample = strtok(samples, ","); sample; sample = strtok(NULL, ",")) {
        const double *row = rows + (size_t)atoll(sample) * width;
        printf("%s[%s, [", separator, sample);
        for (size_t j = first; j < width; j += distance)
            printf("%s%.17g", j > first ? ", " : "", row[j]);
        printf("]]");
        separator = ", ";
    }
    printf("]}\n");
}

#endif
