/* Semihosting: what the debugger or the emulator at the other end does for the processor. In port_cortex_m.c. */
#ifndef DEBUGGER_H
#define DEBUGGER_H

enum { SYS_OPEN = 1, SYS_WRITE = 5, SYS_SEEK = 10 };

int port_semihosting(int operation, const void *argument);
void port_print(const char *line);
void port_exit(int code);

#endif
