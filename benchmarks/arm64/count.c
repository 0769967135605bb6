/* A QEMU plug-in that counts the instructions of an aarch64 program. At each call of getppid(), by which the program
   marks a point, it prints the count since the start. The interface is that of qemu-plugin.h, version 1. */

#include <inttypes.h>
#include <stdio.h>

typedef uint64_t plugin_id;
struct tb;
struct info;
enum { ADD_U64 = 0, GETPPID = 173 };

extern void qemu_plugin_register_vcpu_tb_trans_cb(plugin_id, void (*)(plugin_id, struct tb *));
extern void qemu_plugin_register_vcpu_tb_exec_inline(struct tb *, int, void *, uint64_t);
extern void qemu_plugin_register_vcpu_syscall_cb(plugin_id, void (*)(plugin_id, unsigned, int64_t, uint64_t, uint64_t,
                                                                     uint64_t, uint64_t, uint64_t, uint64_t, uint64_t,
                                                                     uint64_t));
extern size_t qemu_plugin_tb_n_insns(const struct tb *);

int qemu_plugin_version = 1;
static uint64_t instructions;

static void count_block(plugin_id id, struct tb *tb)
{
    qemu_plugin_register_vcpu_tb_exec_inline(tb, ADD_U64, &instructions, qemu_plugin_tb_n_insns(tb));
}

static void print_count(plugin_id id, unsigned cpu, int64_t number, uint64_t a, uint64_t b, uint64_t c, uint64_t d,
                        uint64_t e, uint64_t f, uint64_t g, uint64_t h)
{
    if (number == GETPPID)
        fprintf(stderr, "%" PRIu64 "\n", instructions);
}

int qemu_plugin_install(plugin_id id, const struct info *info, int argc, char **argv)
{
    qemu_plugin_register_vcpu_tb_trans_cb(id, count_block);
    qemu_plugin_register_vcpu_syscall_cb(id, print_count);
    return 0;
}
