#include "interpreter.hpp"

#include <atomic>
#include <chrono>
#include <thread>

namespace srm {

namespace {

using namespace std::chrono_literals;

// How long the end of the program waits for Python code that the kernel called.
constexpr auto patience = 5s;

std::atomic<bool> ending{false};
// The thread that ends the program, which goes on.
std::atomic<std::thread::id> ender{};
// Threads that ask for the lock, or run Python code called by the kernel.  A thread counts itself
// before it looks at `ending`; the end of the program sets `ending` before it looks at the count.
std::atomic<int> in_python{0};

bool has_to_sleep() { return ending && ender.load() != std::this_thread::get_id(); }

void enter_python() {
    ++in_python;
    if (!has_to_sleep()) return;
    --in_python;
    if (PyGILState_Check()) PyEval_SaveThread();
    sleep_if_ending();
}

void put_to_sleep() {
    ender = std::this_thread::get_id();
    ending = true;
    const auto deadline = std::chrono::steady_clock::now() + patience;
    PyThreadState* state = PyEval_SaveThread();
    while (in_python > 0 && std::chrono::steady_clock::now() < deadline)
        std::this_thread::sleep_for(1ms);
    PyEval_RestoreThread(state);
}

}  // namespace

void sleep_if_ending() {
    if (!ending.load(std::memory_order_relaxed)) return;
    while (has_to_sleep()) std::this_thread::sleep_for(1h);
}

WithoutLock::WithoutLock() : state_(PyEval_SaveThread()) {}

WithoutLock::~WithoutLock() {
    enter_python();
    PyEval_RestoreThread(state_);
    --in_python;
}

WithLock::WithLock() {
    enter_python();
    state_ = PyGILState_Ensure();
}

WithLock::~WithLock() {
    PyGILState_Release(state_);
    --in_python;
}

void sleep_at_exit() {
    namespace nb = nanobind;
    nb::module_::import_("atexit").attr("register")(nb::cpp_function(&put_to_sleep));
}

}  // namespace srm
