// What is compiled once for each instruction set, and chosen from at run time.
#pragma once

#include <cstring>

// The table of that name, or the best one where the name is empty; null where the processor lacks it.
template <class Table>
const Table *named(const char *name, const Table &base, [[maybe_unused]] const Table *avx2,
                   [[maybe_unused]] const Table *avx512) {
    const bool best = !*name;
#if defined(COLMAP_INERTIAL_X86_64)
    __builtin_cpu_init();
    const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (has_avx2 && __builtin_cpu_supports("avx512f") && (best || !std::strcmp(name, avx512->name))) return avx512;
    if (has_avx2 && (best || !std::strcmp(name, avx2->name))) return avx2;
#endif
    return best || !std::strcmp(name, base.name) ? &base : nullptr;
}
