#define _GNU_SOURCE
#include "unix_folder.h"

#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum { OTHERS_ENTER_OR_WRITE = S_IRWXG | S_IRWXO, OTHERS_WRITE = S_IWGRP | S_IWOTH, OTHERS_ENTER = S_IXGRP | S_IXOTH };

static int refuse(char *why, int size, const char *folder, const char *words)
{
    snprintf(why, (size_t)size, "%s %s", folder, words);
    return -1;
}

static int refuse_above(char *why, int size, const char *above, const char *folder, const char *words)
{
    snprintf(why, (size_t)size, "%s, above %s, %s", above, folder, words);
    return -1;
}

static void parent_of(const char *path, char *parent)
{
    const char *slash = strrchr(path, '/');
    const size_t length = slash == path ? 1 : (size_t)(slash - path);
    memmove(parent, path, length);
    parent[length] = 0;
}

static int make(const char *folder)
{
    char part[PATH_MAX];
    for (const char *end = folder; end && *end;) {
        end = strchr(end + 1, '/');
        const size_t length = end ? (size_t)(end - folder) : strlen(folder);
        memcpy(part, folder, length);
        part[length] = 0;
        struct stat found;
        if (lstat(part, &found) != 0 && mkdir(part, 0700) != 0 && errno != EEXIST)
            return -1;
    }
    return 0;
}

static int require_private(const char *folder, int is_named, char *why, int size)
{
    struct stat found;
    if (lstat(folder, &found) != 0)
        return refuse(why, size, folder, strerror(errno));
    if (S_ISLNK(found.st_mode))
        return refuse(why, size, folder, "is a link; give a path where there is nothing yet");
    if (!S_ISDIR(found.st_mode))
        return refuse(why, size, folder, "is no folder; give a path where there is nothing yet");
    if (found.st_uid != getuid())
        return refuse(why, size, folder, "belongs to another user; give a path of your own");
    if (found.st_mode & OTHERS_ENTER_OR_WRITE) {
        if (!is_named)
            return refuse(why, size, folder, "is open to other users; chmod 700 it, or give a path where there is nothing");
        chmod(folder, 0700); /* nobody but us has a reason to make it */
    }
    return 0;
}

/* Nobody else may put another folder in this one's place: look at the links that lead there, and at all folders above
   it from the root on, as far as others come. */
static int require_safe_way(const char *folder, char *why, int size)
{
    char above[PATH_MAX], real[PATH_MAX];
    struct stat found;
    for (parent_of(folder, above);; parent_of(above, above)) {
        if (lstat(above, &found) == 0 && S_ISLNK(found.st_mode) && found.st_uid != 0 && found.st_uid != getuid())
            return refuse_above(why, size, above, folder, "is another user's link; give a path of your own");
        if (strcmp(above, "/") == 0)
            break;
    }
    if (!realpath(folder, real))
        return refuse(why, size, folder, strerror(errno));
    for (char *end = real; end; end = strchr(end + 1, '/')) { /* "/", "/a", "/a/b" ... without the folder itself */
        const size_t length = end == real ? 1 : (size_t)(end - real);
        memcpy(above, real, length);
        above[length] = 0;
        if (stat(above, &found) != 0)
            return refuse(why, size, above, strerror(errno));
        if (found.st_uid != 0 && found.st_uid != getuid())
            return refuse_above(why, size, above, folder, "belongs to another user; give a path of your own");
        if (found.st_mode & OTHERS_WRITE && !(found.st_mode & S_ISVTX))
            return refuse_above(why, size, above, folder, "can be written to by other users; give a path elsewhere");
        if (!(found.st_mode & OTHERS_ENTER))
            return 0;
    }
    return 0;
}

int folder_open(const char *folder, int is_named, char *why, int size)
{
    char above[PATH_MAX];
    parent_of(folder, above);
    if (make(folder) != 0)
        return refuse(why, size, folder, strerror(errno));
    if (is_named && require_private(above, is_named, why, size) != 0)
        return -1;
    if (require_private(folder, is_named, why, size) != 0)
        return -1;
    return require_safe_way(folder, why, size);
}

void folder_close(const char *folder, int is_named)
{
    if (is_named)
        rmdir(folder);
}

static const char *digits(const char *text)
{
    const char *end = text;
    while (*end >= '0' && *end <= '9')
        end++;
    return end > text ? end : 0;
}

int is_our_name(const char *name)
{
    const char *at = strncmp(name, "pkxyz-", 6) == 0 ? digits(name + 6) : 0;
    at = at && *at == '-' ? digits(at + 1) : 0;
    return at && *at == 0;
}

void remove_socket(const char *path)
{
    struct stat found;
    const char *slash = strrchr(path, '/');
    if (slash && is_our_name(slash + 1) && lstat(path, &found) == 0 && S_ISSOCK(found.st_mode) && found.st_uid == getuid())
        unlink(path);
}
