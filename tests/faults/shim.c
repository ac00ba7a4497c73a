/* Faults at file operations, for one process and one folder.

   Preloaded, it counts the operations on files below the folder, and at the chosen one
   kills the process or fails. Until fault_arm is called nothing is counted. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum { OFF, COUNT, KILL, ONCE, FROM_THEN_ON };
enum { READS = 0, WRITES = 1 };

static char root[4096];
static int kind = OFF, error_number, list = -1;
static long at, count;

/* Counts the operations on files below `folder` from now on. Each is a line in the file
   `list_fd`, if that is not negative: whether it writes, number, name, path. Operation
   number `when`, from 1, meets its fault: KILL ends the process, ONCE and FROM_THEN_ON
   fail with `number`. ENOSPC and EDQUOT only meet what writes. */
void fault_arm(const char *folder, int what, long when, int number, int list_fd) {
  snprintf(root, sizeof root, "%s", folder);
  kind = what, at = when, error_number = number, list = list_fd, count = 0;
}

static int below(const char *path) {
  size_t size = strlen(root);
  return !strncmp(path, root, size) && (path[size] == '/' || !path[size]);
}

/* Writes the absolute path of `path` at `folder` to `found`. */
static int locate(int folder, const char *path, char *found, size_t size) {
  if (!path) return 0;
  if (path[0] == '/') return snprintf(found, size, "%s", path) > 0;
  char link[64], base[4096];
  if (folder == AT_FDCWD)
    snprintf(link, sizeof link, "/proc/self/cwd");
  else
    snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
  ssize_t got = readlink(link, base, sizeof base - 1);
  if (got < 0) return 0;
  base[got] = 0;
  return snprintf(found, size, path[0] ? "%s/%s" : "%s", base, path) > 0;
}

/* Counts one operation; returns whether it is to fail. */
static int fault(const char *name, int writes, int folder, const char *path) {
  char whole[8192];
  if (kind == OFF || !locate(folder, path, whole, sizeof whole) || !below(whole))
    return 0;
  int space = error_number == ENOSPC || error_number == EDQUOT;
  if (!writes && (kind == KILL || space)) return 0; /* as if it had not been */
  long number = __atomic_add_fetch(&count, 1, __ATOMIC_SEQ_CST);
  if (list >= 0)
    dprintf(list, "%s %ld %s %s\n", writes ? "write" : "read", number, name,
            whole + strlen(root));
  if (kind == KILL && number == at) kill(getpid(), SIGKILL);
  int fails = (kind == ONCE && number == at) || (kind == FROM_THEN_ON && number >= at);
  if (fails) errno = error_number;
  return fails;
}

#define REAL(result, name, ...)                              \
  static result (*real)(__VA_ARGS__);                        \
  if (!real) real = (result(*)(__VA_ARGS__))dlsym(RTLD_NEXT, #name)

#define OPENING(name, folder, types, values, ...)            \
  int name types {                                           \
    REAL(int, name, __VA_ARGS__);                            \
    va_list rest;                                            \
    va_start(rest, flags);                                   \
    mode_t mode = va_arg(rest, mode_t);                      \
    va_end(rest);                                            \
    int writes = flags & (O_CREAT | O_WRONLY | O_RDWR | O_TRUNC); \
    if (fault(#name, !!writes, folder, path)) return -1;     \
    return real values;                                      \
  }
#define OPEN(name)                                           \
  OPENING(name, AT_FDCWD, (const char *path, int flags, ...), \
          (path, flags, mode), const char *, int, ...)
#define OPENAT(name)                                         \
  OPENING(name, folder, (int folder, const char *path, int flags, ...), \
          (folder, path, flags, mode), int, const char *, int, ...)
OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)

/* Operations on an open file: the file is the first argument. */
#define ON_FILE(result, name, writes, types, values, ...)    \
  result name types {                                        \
    REAL(result, name, __VA_ARGS__);                         \
    if (fault(#name, writes, file, "")) return -1;           \
    return real values;                                      \
  }
ON_FILE(ssize_t, read, READS, (int file, void *to, size_t size), (file, to, size),
        int, void *, size_t)
ON_FILE(ssize_t, pread, READS, (int file, void *to, size_t size, off_t offset),
        (file, to, size, offset), int, void *, size_t, off_t)
ON_FILE(ssize_t, pread64, READS, (int file, void *to, size_t size, off64_t offset),
        (file, to, size, offset), int, void *, size_t, off64_t)
ON_FILE(ssize_t, write, WRITES, (int file, const void *data, size_t size),
        (file, data, size), int, const void *, size_t)
ON_FILE(ssize_t, pwrite, WRITES,
        (int file, const void *data, size_t size, off_t offset),
        (file, data, size, offset), int, const void *, size_t, off_t)
ON_FILE(ssize_t, pwrite64, WRITES,
        (int file, const void *data, size_t size, off64_t offset),
        (file, data, size, offset), int, const void *, size_t, off64_t)
ON_FILE(ssize_t, writev, WRITES, (int file, const struct iovec *parts, int number),
        (file, parts, number), int, const struct iovec *, int)
ON_FILE(int, fsync, WRITES, (int file), (file), int)
ON_FILE(int, fdatasync, WRITES, (int file), (file), int)
ON_FILE(int, ftruncate, WRITES, (int file, off_t size), (file, size), int, off_t)
ON_FILE(int, ftruncate64, WRITES, (int file, off64_t size), (file, size), int, off64_t)

/* Operations on a name. */
#define ON_NAME(name, folder, path, types, values, ...)      \
  int name types {                                           \
    REAL(int, name, __VA_ARGS__);                            \
    if (fault(#name, WRITES, folder, path)) return -1;       \
    return real values;                                      \
  }
ON_NAME(mkdir, AT_FDCWD, path, (const char *path, mode_t mode), (path, mode),
        const char *, mode_t)
ON_NAME(mkdirat, folder, path, (int folder, const char *path, mode_t mode),
        (folder, path, mode), int, const char *, mode_t)
ON_NAME(rmdir, AT_FDCWD, path, (const char *path), (path), const char *)
ON_NAME(unlink, AT_FDCWD, path, (const char *path), (path), const char *)
ON_NAME(unlinkat, folder, path, (int folder, const char *path, int flags),
        (folder, path, flags), int, const char *, int)
ON_NAME(rename, AT_FDCWD, to, (const char *from, const char *to), (from, to),
        const char *, const char *)
ON_NAME(renameat, folder, to, (int from_folder, const char *from, int folder,
        const char *to), (from_folder, from, folder, to),
        int, const char *, int, const char *)
ON_NAME(renameat2, folder, to, (int from_folder, const char *from, int folder,
        const char *to, unsigned flags), (from_folder, from, folder, to, flags),
        int, const char *, int, const char *, unsigned)
ON_NAME(link, AT_FDCWD, to, (const char *from, const char *to), (from, to),
        const char *, const char *)
ON_NAME(truncate, AT_FDCWD, path, (const char *path, off_t size), (path, size),
        const char *, off_t)
