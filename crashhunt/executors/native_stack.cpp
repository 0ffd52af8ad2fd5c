// Writes the native stack of a process that dies of a signal, before the handlers that were installed earlier run.
//
// An agent that is a shared library runs in the process of the trial. Python's faulthandler writes the Python calls of a
// dying process, which end at the call of the library. This library writes the calls inside it.
//
// crashhunt/executors/_native_stack.py loads it, and finds function and line of each call after the process has died.

#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <dlfcn.h>
#include <execinfo.h>
#include <signal.h>
#include <string.h>
#include <ucontext.h>
#include <unistd.h>

#include <cstdint>

#ifndef CRASHHUNT_INTERFACE
#error "scripts/build_core.py defines CRASHHUNT_INTERFACE"
#endif

#define EXPORTED __attribute__((visibility("default")))

namespace {

const int fatal[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};
const int max_frames = 32;
struct sigaction earlier[NSIG];
alignas(16) char alternate_stack[1 << 16];  // the stack of the thread may be exhausted
volatile sig_atomic_t output = -1, target = -1;

void put(const char *text) {
    ssize_t written = write(target, text, strlen(text));
    (void)written;
}

void put_number(std::uintptr_t number) {
    char digits[2 + 2 * sizeof number + 1], *first = digits + sizeof digits - 1;
    *first = 0;
    do {
        *--first = "0123456789abcdef"[number % 16];
        number /= 16;
    } while (number);
    *--first = 'x';
    *--first = '0';
    put(first);
}

// The instruction that was interrupted; 0 if it is unknown.
void *interrupted(const void *context) {
#if defined(__x86_64__)
    return reinterpret_cast<void *>(static_cast<const ucontext_t *>(context)->uc_mcontext.gregs[REG_RIP]);
#elif defined(__aarch64__)
    return reinterpret_cast<void *>(static_cast<const ucontext_t *>(context)->uc_mcontext.pc);
#else
    (void)context;
    return nullptr;
#endif
}

// The instruction after the call that led to an address without code, such as a call through a null pointer.
void *caller(const void *context) {
#if defined(__x86_64__)
    return *reinterpret_cast<void **>(static_cast<const ucontext_t *>(context)->uc_mcontext.gregs[REG_RSP]);
#elif defined(__aarch64__)
    return reinterpret_cast<void *>(static_cast<const ucontext_t *>(context)->uc_mcontext.regs[30]);
#else
    (void)context;
    return nullptr;
#endif
}

// A line `PATH\tOFFSET\tFUNCTION`. The offset of a call is that of the call instruction, not of the next one.
void put_frame(void *address, bool is_call) {
    Dl_info found;
    if (!dladdr(address, &found) || !found.dli_fname) {
        put("?\t");
        put_number(reinterpret_cast<std::uintptr_t>(address));
        put("\t\n");
        return;
    }
    put(found.dli_fname);
    put("\t");
    put_number(reinterpret_cast<std::uintptr_t>(address) - reinterpret_cast<std::uintptr_t>(found.dli_fbase) - is_call);
    put("\t");
    put(found.dli_sname ? found.dli_sname : "");
    put("\n");
}

void write_stack(int number, siginfo_t *info, void *context) {
    if (output >= 0) {
        target = output;
        output = -1;  // whatever fails from here on
        void *frames[max_frames + 8], *place = interrupted(context);
        int count = backtrace(frames, max_frames + 8), first = 0;
        while (first < count && frames[first] != place) {  // this handler and its caller come first
            first++;
        }
        put("native stack\n");
        Dl_info found;
        if (place && dladdr(place, &found)) {
            put_frame(place, false);
        } else {
            put_frame(caller(context), true);
        }
        for (first++; first < count && first < max_frames; first++) {
            put_frame(frames[first], true);
        }
        put("end of the native stack\n");
    }
    const struct sigaction &next = earlier[number];
    if (next.sa_flags & SA_SIGINFO) {
        next.sa_sigaction(number, info, context);
    } else if (next.sa_handler != SIG_DFL && next.sa_handler != SIG_IGN) {
        next.sa_handler(number);
    } else {
        sigaction(number, &next, nullptr);
        raise(number);
    }
}

}  // namespace

extern "C" {

EXPORTED int crashhunt_native_stack_interface() { return CRASHHUNT_INTERFACE; }

// Write the stack of this process to a file if the process dies; a negative descriptor ends this.
EXPORTED void crashhunt_native_stack_write_to(int descriptor) {
    static bool is_installed = false;
    void *frame;
    backtrace(&frame, 1);  // the first call loads a library, which a signal handler must not do
    output = descriptor;
    if (is_installed || descriptor < 0) {
        return;
    }
    is_installed = true;
    stack_t stack = {};
    stack.ss_sp = alternate_stack;
    stack.ss_size = sizeof alternate_stack;
    sigaltstack(&stack, nullptr);
    struct sigaction ours = {};
    ours.sa_sigaction = write_stack;
    ours.sa_flags = SA_SIGINFO | SA_ONSTACK | SA_NODEFER;
    sigemptyset(&ours.sa_mask);
    for (int number : fatal) {
        sigaction(number, &ours, &earlier[number]);
    }
}
}
