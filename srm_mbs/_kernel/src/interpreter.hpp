// The interpreter's lock, given up and taken again by threads that may outlive the interpreter.
//
// When a program ends while a daemon thread runs, CPython (before 3.14) ends that thread where it
// asks for the lock, by unwinding its stack: through C++ frames that is an abort, be they the
// kernel's or those of a library that gives up the lock in C++, as NumPy does.  Threads of the
// kernel therefore sleep from then on, and never ask again.
#pragma once

#include <nanobind/nanobind.h>

namespace srm {

// Sleeps for ever if the interpreter is ending; to be called without the lock.
void sleep_if_ending();

// Between these calls a thread runs Python code, or asks for the lock to do so: the end of the
// program waits until it leaves, or enters again and sleeps.  With or without the lock.
void enter_python();
void leave_python();

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

// Has atexit put the threads of the kernel to sleep, and wait until they do.
void sleep_at_exit();

}  // namespace srm
