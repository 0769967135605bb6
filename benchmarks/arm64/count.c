/* Plug-in of QEMU: counts the instructions of an aarch64 program. At each call of getppid(), which the program makes to
   mark a point, it prints what has been counted since the start: instructions, bytes loaded and stored, and
   multiply-adds of single numbers in vectors. The interface is that of qemu-plugin.h, version 1. */

#include <inttypes.h>
#include <stdio.h>
#include <string.h>

typedef uint64_t plugin_id;
struct tb;
struct insn;
struct info;
enum { ADD_U64 = 0, GETPPID = 173 };

extern void qemu_plugin_register_vcpu_tb_trans_cb(plugin_id, void (*)(plugin_id, struct tb *));
extern void qemu_plugin_register_vcpu_tb_exec_inline(struct tb *, int, void *, uint64_t);
extern void qemu_plugin_register_vcpu_syscall_cb(plugin_id, void (*)(plugin_id, unsigned, int64_t, uint64_t, uint64_t,
                                                                     uint64_t, uint64_t, uint64_t, uint64_t, uint64_t,
                                                                     uint64_t));
extern size_t qemu_plugin_tb_n_insns(const struct tb *);
extern struct insn *qemu_plugin_tb_get_insn(const struct tb *, size_t);
extern const void *qemu_plugin_insn_data(const struct insn *);

int qemu_plugin_version = 1;
static uint64_t instructions, bytes, multiply_adds;

static unsigned bits(uint32_t word, int high, int low) { return word >> low & ((1u << (high - low + 1)) - 1); }

/* Bytes that one instruction loads or stores (Arm Architecture Reference Manual, C4.1: loads and stores). */
static unsigned moved(uint32_t word)
{
    unsigned vector = bits(word, 26, 26), size = bits(word, 31, 30);
    if (bits(word, 27, 27) != 1 || bits(word, 25, 25) != 0)
        return 0;
    switch (bits(word, 29, 28)) {
    case 0:
        if (!vector)
            return 1u << size; /* exclusive and ordered */
        if (bits(word, 24, 24))
            return 4 << bits(word, 13, 13); /* one element of each register */
        static const unsigned registers[16] = {4, 0, 4, 0, 3, 0, 3, 1, 2, 0, 2};
        return registers[bits(word, 15, 12)] * (8 << bits(word, 30, 30));
    case 1:
        return vector ? 4u << size : size & 1 ? 8 : 4; /* beside the program */
    case 2:
        return 2 * (vector ? 4u << size : size & 2 ? 8 : 4); /* pairs */
    default:
        return vector && bits(word, 23, 23) ? 16 : 1u << size;
    }
}

/* Multiply-adds of FMLA and FMLS, by a vector or by one of its elements. */
static unsigned multiplied(uint32_t word)
{
    int by_vector = (word & 0xbf20fc00) == 0x0e20cc00, by_element = (word & 0xbf00b400) == 0x0f001000;
    if (!by_vector && !by_element)
        return 0;
    return (bits(word, 30, 30) ? 16 : 8) / (bits(word, 22, 22) ? 8 : 4);
}

static void translated(plugin_id id, struct tb *tb)
{
    uint64_t count = qemu_plugin_tb_n_insns(tb), here_bytes = 0, here_multiplied = 0;
    for (size_t at = 0; at < count; at++) {
        uint32_t word;
        memcpy(&word, qemu_plugin_insn_data(qemu_plugin_tb_get_insn(tb, at)), sizeof word);
        here_bytes += moved(word);
        here_multiplied += multiplied(word);
    }
    qemu_plugin_register_vcpu_tb_exec_inline(tb, ADD_U64, &instructions, count);
    if (here_bytes)
        qemu_plugin_register_vcpu_tb_exec_inline(tb, ADD_U64, &bytes, here_bytes);
    if (here_multiplied)
        qemu_plugin_register_vcpu_tb_exec_inline(tb, ADD_U64, &multiply_adds, here_multiplied);
}

static void called(plugin_id id, unsigned cpu, int64_t number, uint64_t a, uint64_t b, uint64_t c, uint64_t d,
                   uint64_t e, uint64_t f, uint64_t g, uint64_t h)
{
    if (number == GETPPID)
        fprintf(stderr, "%" PRIu64 " %" PRIu64 " %" PRIu64 "\n", instructions, bytes, multiply_adds);
}

int qemu_plugin_install(plugin_id id, const struct info *info, int argc, char **argv)
{
    qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
    qemu_plugin_register_vcpu_syscall_cb(id, called);
    return 0;
}
