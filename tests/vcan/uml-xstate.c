/* Lets Debian's user-mode Linux 6.1 run on hosts with a larger x86 extended register state than it
 * supports.
 *
 * That kernel saves and restores the state of its processes with ptrace, in a buffer of fixed size
 * for AVX-512. On a CPU with a larger state (AMX: 11008 bytes) the host accepts the short read but
 * not the short write ("userspace - ptrace set fp regs failed, errno = 14"): it needs the whole
 * buffer. This preloaded library completes the write. The parts that do not fit in the short buffer
 * get their initial state. Newer kernels (6.13) ask the host for the size and do not need this.
 * Only `with-vcan` builds and uses it.
 */
#define _GNU_SOURCE
#include <cpuid.h>
#include <dlfcn.h>
#include <elf.h>
#include <errno.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

/* Offset of the bits that say which components the XSAVE area has (Intel SDM 1, 13.4.2). */
#define XSTATE_BV 512

/* The components that end beyond `length` bytes. CPUID is only called the first time: in a virtual
 * machine each CPUID is a call to the hypervisor, and sixty of them at every process switch make
 * everything inside a hundred times slower.
 */
static unsigned long beyond(size_t length)
{
    static unsigned long end[63]; /* of each component; 0: none */
    static int asked;
    unsigned long those = 0;
    unsigned size, offset, c, d;

    for (unsigned i = 2; !asked && i < 63; i++) {
        __cpuid_count(0xd, i, size, offset, c, d);
        end[i] = size == 0 ? 0 : (unsigned long)offset + size;
    }
    asked = 1;
    for (unsigned i = 2; i < 63; i++)
        if (end[i] > length)
            those |= 1UL << i;
    return those;
}

static long complete_write(pid_t pid, void *type, const struct iovec *given)
{
    static unsigned char whole[65536] __attribute__((aligned(64)));
    struct iovec iov = {whole, sizeof whole};
    unsigned long components;

    /* A read of the whole state returns its length, and the part that the caller does not give. */
    if (syscall(SYS_ptrace, PTRACE_GETREGSET, pid, type, &iov) < 0)
        return -1;
    if (given->iov_len < XSTATE_BV + sizeof components || given->iov_len >= iov.iov_len)
        return syscall(SYS_ptrace, PTRACE_SETREGSET, pid, type, given);

    memcpy(whole, given->iov_base, given->iov_len);
    memcpy(&components, whole + XSTATE_BV, sizeof components);
    components &= ~beyond(given->iov_len);
    memcpy(whole + XSTATE_BV, &components, sizeof components);
    return syscall(SYS_ptrace, PTRACE_SETREGSET, pid, type, &iov);
}

long ptrace(enum __ptrace_request request, ...)
{
    static long (*next)(enum __ptrace_request, pid_t, void *, void *);
    va_list list;
    va_start(list, request);
    pid_t pid = va_arg(list, pid_t);
    void *address = va_arg(list, void *);
    void *data = va_arg(list, void *);
    va_end(list);

    if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE)
        return complete_write(pid, address, data);
    if (!next)
        next = (long (*)(enum __ptrace_request, pid_t, void *, void *))dlsym(RTLD_NEXT, "ptrace");
    return next(request, pid, address, data);
}
