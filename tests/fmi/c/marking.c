/* An FMU that leaves a file behind as soon as its library is loaded: what runs code, shows. */
#include <stdio.h>

__attribute__((constructor)) static void mark(void)
{
    FILE *file = fopen(MARK, "w");

    if (file != NULL)
        fclose(file);
}
