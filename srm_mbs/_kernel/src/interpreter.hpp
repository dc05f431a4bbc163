// The interpreter's lock, given up and taken again by threads that may outlive the interpreter.
//
// When a program ends while a daemon thread is in the kernel, CPython (before 3.14) ends that thread
// where it asks for the lock, by unwinding its stack: through C++ frames that is an abort.  Threads
// of the kernel therefore sleep from then on, and never ask again.
#pragma once

#include <nanobind/nanobind.h>

namespace srm {

// Sleeps for ever if the interpreter is ending; to be called without the lock.
void sleep_if_ending();

// Gives the lock up, for a scope.
class WithoutLock {
public:
    WithoutLock();
    ~WithoutLock();
    WithoutLock(const WithoutLock&) = delete;
    WithoutLock& operator=(const WithoutLock&) = delete;

private:
    PyThreadState* state_;
};

// Takes the lock for a scope that calls Python code, also in the thread that has it.
class WithLock {
public:
    WithLock();
    ~WithLock();
    WithLock(const WithLock&) = delete;
    WithLock& operator=(const WithLock&) = delete;

private:
    PyGILState_STATE state_;
};

// Has atexit put the threads of the kernel to sleep, once Python code that they called has returned.
void sleep_at_exit();

}  // namespace srm
