/* The port of a machine with an operating system. */
#include <stdio.h>
#include <stdlib.h>

void port_print(const char *line)
{
    puts(line);
}

void port_exit(int code)
{
    exit(code);
}
