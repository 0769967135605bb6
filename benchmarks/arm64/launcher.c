/* The Python of the aarch64 system, as a program of this machine: it hands itself to QEMU. So a test that starts Python
   starts an emulated one, and this machine's kernel need not know how to run programs for ARM. */

#include <stdlib.h>
#include <unistd.h>

int main(int argc, char **argv)
{
    const char *before[] = {QEMU, "-cpu", CPU, "-L", SYSTEM, "-0", argv[0], PYTHON};
    int count = sizeof before / sizeof *before;
    const char **all = calloc(count + argc, sizeof *all);
    for (int at = 0; at < count; at++)
        all[at] = before[at];
    for (int at = 1; at < argc; at++)
        all[count - 1 + at] = argv[at];
    execv(QEMU, (char **)all);
    return 127;
}
