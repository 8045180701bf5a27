// SPDX-License-Identifier: Apache-2.0
// Preloaded into a process, kills it before the n-th system call that changes a file, or has such
// calls fail, in one folder only. Python and SQLite call the system through these functions.

#include <cerrno>
#include <csignal>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <dlfcn.h>
#include <fcntl.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

namespace {
long calls_left = -1;  // before the process is killed; negative: never
long calls = 0;
long calls_right = 0, calls_wrong = 0;  // that succeed, and that fail after them
int error = 0;  // with which they fail
char folder[4096] = "";  // only calls for files in it count

bool in_folder(const char * path) {
  return *folder && std::strncmp(path, folder, std::strlen(folder)) == 0;
}

bool in_folder(int descriptor) {
  char link[64], path[4096];
  std::snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
  ssize_t size = readlink(link, path, sizeof path - 1);
  if (size < 0) return false;
  path[size] = 0;
  return in_folder(path);
}

template<class Function>
Function real(const char * name) { return reinterpret_cast<Function>(dlsym(RTLD_NEXT, name)); }

// The number of the error that FAULT_FLAG, a file, holds; 0 without such a file.
int failure() {
  const char * flag = std::getenv("FAULT_FLAG");
  int file = flag ? real<int (*)(const char *, int, ...)>("open")(flag, O_RDONLY) : -1;
  if (file < 0) return 0;
  char text[16] = "";
  ssize_t size = read(file, text, sizeof text - 1);
  close(file);
  return size > 0 ? std::atoi(text) : 0;
}

template<class File>
bool fails(File file) {
  if (!in_folder(file)) return false;
  ++calls;
  if (calls_left >= 0 && calls_left-- == 0) raise(SIGKILL);
  int number = failure();
  if (calls_right > 0) --calls_right;
  else if (calls_wrong > 0) { --calls_wrong; number = error; }
  if (number) errno = number;
  return number != 0;
}

__attribute__((constructor)) void start() {
  if (const char * path = std::getenv("FAULT_FOLDER")) std::strncpy(folder, path, sizeof folder - 1);
}
}  // namespace

extern "C" {
void faults_arm(const char * path, long before) {
  std::strncpy(folder, path, sizeof folder - 1);
  calls = 0;
  calls_left = before;
  calls_right = calls_wrong = 0;
}
void faults_fail(const char * path, long before, long count, int number) {
  faults_arm(path, -1);
  calls_right = before;
  calls_wrong = count;
  error = number;
}
long faults_calls() { return calls; }

#define ONE(result, name, parameters, arguments, file) \
  result name parameters { \
    static auto call = real<result (*) parameters>(#name); \
    return fails(file) ? -1 : call arguments; \
  }
ONE(ssize_t, write, (int fd, const void * data, size_t size), (fd, data, size), fd)
ONE(ssize_t, pwrite, (int fd, const void * data, size_t size, off_t at), (fd, data, size, at), fd)
ONE(ssize_t, pwrite64, (int fd, const void * data, size_t size, off64_t at), (fd, data, size, at), fd)
ONE(int, fsync, (int fd), (fd), fd)
ONE(int, fdatasync, (int fd), (fd), fd)
ONE(int, ftruncate, (int fd, off_t size), (fd, size), fd)
ONE(int, ftruncate64, (int fd, off64_t size), (fd, size), fd)
ONE(int, mkdir, (const char * path, mode_t mode), (path, mode), path)
ONE(int, unlink, (const char * path), (path), path)
ONE(int, rename, (const char * from, const char * to), (from, to), to)

#define OPEN(name) \
  int name(const char * path, int flags, ...) { \
    static auto call = real<int (*)(const char *, int, ...)>(#name); \
    va_list more; \
    va_start(more, flags); \
    mode_t mode = flags & O_CREAT ? va_arg(more, mode_t) : 0; \
    va_end(more); \
    bool changes = flags & (O_CREAT | O_WRONLY | O_RDWR); \
    return changes && fails(path) ? -1 : call(path, flags, mode); \
  }
OPEN(open)
OPEN(open64)
}
