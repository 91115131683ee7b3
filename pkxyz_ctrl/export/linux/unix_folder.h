/* The folder of a bus among processes: whose it must be. Whoever can write to it can send frames, and whoever can move
   it can put another in its place, so nobody else may do either; and nothing but our own sockets is ever taken away. */
#ifndef UNIX_FOLDER_H
#define UNIX_FOLDER_H

/* Makes the folder if there is none. 0, or -1 and why it is none to put sockets in. is_named: it stands for a name, and
   the folder above it is ours, too. */
int folder_open(const char *folder, int is_named, char *why, int size);

/* The last one out takes away a folder that stands for a name. */
void folder_close(const char *folder, int is_named);

/* pkxyz-<process>-<number>: the name of a participant's socket. */
int is_our_name(const char *name);

/* Removes a socket of ours; whatever else has that name stays. */
void remove_socket(const char *path);

#endif
