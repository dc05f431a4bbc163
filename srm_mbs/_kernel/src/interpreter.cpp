#include "interpreter.hpp"

#include <atomic>
#include <chrono>
#include <thread>

namespace srm {

namespace {

using namespace std::chrono_literals;

// How long the end of the program waits for other threads to sleep.
constexpr auto patience = 5s;

std::atomic<bool> ending{false};
// The thread that ends the program, which goes on.
std::atomic<std::thread::id> ender{};
// Threads that ask for the lock or run Python code called by the kernel or between its calls; a
// thread counts once for each such scope.  It counts itself before it looks at `ending`; the end of
// the program sets `ending` before it looks at the count.
std::atomic<int> in_python{0};
// The part of the count that this thread made.
thread_local int own = 0;

void count(int change) {
    own += change;
    in_python += change;
}

bool has_to_sleep() { return ending && ender.load() != std::this_thread::get_id(); }

void sleep() {
    count(-own);
    for (;;) std::this_thread::sleep_for(1h);
}

void put_to_sleep() {
    ender = std::this_thread::get_id();
    ending = true;
    const auto deadline = std::chrono::steady_clock::now() + patience;
    PyThreadState* state = PyEval_SaveThread();
    while (in_python > own && std::chrono::steady_clock::now() < deadline)
        std::this_thread::sleep_for(1ms);
    PyEval_RestoreThread(state);
}

// A child process has this thread alone.
void forget_other_threads() { in_python = own; }

}  // namespace

void sleep_if_ending() {
    if (ending.load(std::memory_order_relaxed) && has_to_sleep()) sleep();
}

void enter_python() {
    count(1);
    if (!has_to_sleep()) return;
    if (PyGILState_Check()) PyEval_SaveThread();
    sleep();
}

void leave_python() { count(-1); }

WithoutLock::WithoutLock() : state_(PyEval_SaveThread()) {}

WithoutLock::~WithoutLock() {
    enter_python();
    PyEval_RestoreThread(state_);
    leave_python();
}

WithLock::WithLock() {
    enter_python();
    state_ = PyGILState_Ensure();
}

WithLock::~WithLock() {
    PyGILState_Release(state_);
    leave_python();
}

void sleep_at_exit() {
    namespace nb = nanobind;
    nb::module_::import_("atexit").attr("register")(nb::cpp_function(&put_to_sleep));
    const nb::module_ os = nb::module_::import_("os");
    if (nb::hasattr(os, "register_at_fork"))
        os.attr("register_at_fork")(nb::arg("after_in_child") =
                                        nb::cpp_function(&forget_other_threads));
}

}  // namespace srm
