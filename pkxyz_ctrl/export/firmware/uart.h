/* The serial line that stands for the bus. A board of yours has a CAN controller in its place. */
#ifndef UART_H
#define UART_H

void uart_open(void);
void uart_put(char character);
char uart_get(void); /* asleep until there is one */

#endif
