/* The port of your board: two functions to fill in, and your own start-up and linker script beside them. */
void port_print(const char *line)
{
    (void)line; /* a UART, a debugger's console */
}

void port_exit(int code)
{
    (void)code;
    for (;;) {
    }
}
