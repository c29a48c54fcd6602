#define _GNU_SOURCE
#include "running.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

COSIM_QUICK_TLS _Thread_local const cosim_messages *cosim_running = NULL;
static const cosim_messages *const volatile *of_first_thread = NULL;

static int32_t describe(const cosim_messages *running, char *text, size_t size)
{
    if (!running || !running->name)
        return 0;
    if (isnan(running->now))
        snprintf(text, size, "%s, before its initialization", running->name);
    else
        snprintf(text, size, "%s, at t = %.15g s", running->name, running->now);
    return 1;
}

int32_t cosim_running_text(char *text, size_t size)
{
    return of_first_thread ? describe(*of_first_thread, text, size) : 0;
}

#ifdef _WIN32

void cosim_report_deaths(void)
{
    of_first_thread = (const cosim_messages *const volatile *)&cosim_running;
}
void cosim_report_log(const char *path) { (void)path; }

#else

#include <dlfcn.h>
#include <signal.h>
#include <unistd.h>
#if __has_include(<execinfo.h>)
#include <execinfo.h>
#define HAS_BACKTRACE
#endif

enum { FRAMES = 64, STACK = 1 << 16 };
static const struct {
    int number;
    const char *name;
} fatal[] = {{SIGSEGV, "SIGSEGV"}, {SIGBUS, "SIGBUS"}, {SIGILL, "SIGILL"},
             {SIGFPE, "SIGFPE"},   {SIGABRT, "SIGABRT"}, {SIGALRM, ""}}; /* the last: no return */
enum { FATAL = sizeof fatal / sizeof fatal[0] };
static struct sigaction before[FATAL];
static char log_path[4096];

static void say(const char *text) { (void)!write(2, text, strlen(text)); }

/* The function of the FMU that was called: the outermost one on the stack with a name of FMI. */
static void say_function(void)
{
#ifdef HAS_BACKTRACE
    void *frames[FRAMES];
    Dl_info found;
    for (int i = backtrace(frames, FRAMES) - 1; i >= 0; i--)
        /* where a call returns to may be the next function already */
        if (dladdr((char *)frames[i] - 1, &found) && found.dli_sname &&
            strstr(found.dli_sname, "fmi")) {
            say("; in ");
            say(found.dli_sname);
            return;
        }
#endif
}

/* What is known for certain first: the stack may be what is broken. */
static void report(const char *how)
{
    char text[1024];
    if (!describe(cosim_running, text, sizeof text))
        return;
    say(isatty(2) ? "\x1b[?25h\ncosim: " : "cosim: "); /* below a line of progress */
    say(text);
    say(": ");
    say(how);
    if (*log_path) {
        say("; its log is ");
        say(log_path);
    }
    say_function();
    say("\n");
}

static void on_signal(int number, siginfo_t *info, void *context)
{
    const int is_sent = info->si_code <= 0 || number == SIGABRT || number == SIGALRM;
    (void)context;
    char how[64] = "crashes: ";
    for (int i = 0; i < FATAL; i++) {
        sigaction(fatal[i].number, &before[i], NULL);
        if (fatal[i].number == number)
            strcat(how, fatal[i].name);
    }
    report(number == SIGALRM ? "does not return" : how);
    /* It comes again behind this handler, to who was there before: what the processor raised by
     * itself, with the address that a virtual machine may wait for. */
    if (is_sent)
        raise(number);
}

#ifdef __GLIBC__
static void on_end(int code, void *nothing)
{
    char how[64];
    (void)nothing;
    snprintf(how, sizeof how, "ends the process with exit code %d", code);
    report(how);
}
#else
static void on_end(void) { report("ends the process"); }
#endif

void cosim_report_log(const char *path)
{
    log_path[0] = 0;
    if (path && strlen(path) < sizeof log_path)
        strcpy(log_path, path);
}

void cosim_report_deaths(void)
{
    static char stack[STACK]; /* for an FMU that has used up the other one */
    stack_t own = {.ss_sp = stack, .ss_size = sizeof stack}, there;
    struct sigaction action;
    if (of_first_thread)
        return;
    of_first_thread = (const cosim_messages *const volatile *)&cosim_running;
#ifdef HAS_BACKTRACE
    void *frames[1];
    backtrace(frames, 1); /* the first call loads what it needs */
#endif
    if (!sigaltstack(NULL, &there) && there.ss_flags & SS_DISABLE)
        sigaltstack(&own, NULL);
    memset(&action, 0, sizeof action);
    action.sa_sigaction = on_signal;
    action.sa_flags = SA_ONSTACK | SA_SIGINFO;
    for (int i = 0; i < FATAL; i++) {
        sigaction(fatal[i].number, NULL, &before[i]);
        if (fatal[i].number != SIGALRM || before[i].sa_handler == SIG_DFL) /* else: not fatal */
            sigaction(fatal[i].number, &action, NULL);
    }
#ifdef __GLIBC__
    on_exit(on_end, NULL);
#else
    atexit(on_end);
#endif
}

#endif
