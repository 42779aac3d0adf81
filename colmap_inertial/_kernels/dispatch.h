// What is compiled once for each instruction set, and chosen from at run time.
#pragma once

#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

// The functions of a kernel for each instruction set; null where they are not compiled, or cannot run.
template <class Table>
struct Tables {
    const Table *base, *avx2 = nullptr, *avx512 = nullptr;

    // The table of that name, or the best one where the name is empty; null where the processor lacks it.
    const Table *find(const std::string &name) const {
        const auto asked = [&name](const Table *table) { return table && (name.empty() || name == table->name); };
#if defined(COLMAP_INERTIAL_X86_64)
        __builtin_cpu_init();
        const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
        if (has_avx2 && __builtin_cpu_supports("avx512f") && asked(avx512)) return avx512;
        if (has_avx2 && asked(avx2)) return avx2;
#endif
        return asked(base) ? base : nullptr;
    }

    const Table &require(const std::string &name) const {
        const Table *table = find(name);
        if (!table) throw std::invalid_argument("instruction_set: unknown, or this processor lacks it");
        return *table;
    }

    // Of those that this processor has.
    std::vector<std::string> names() const {
        std::vector<std::string> out;
        for (const Table *table : {base, avx2, avx512})
            if (table && find(table->name)) out.emplace_back(table->name);
        return out;
    }
};

// {NAME_base, ...}: the tables that each_set.h defines, as far as they are compiled.
#if defined(COLMAP_INERTIAL_X86_64)
#define TABLES_OF(kernel) {&kernel##_base, &kernel##_avx2, &kernel##_avx512}
#else
#define TABLES_OF(kernel) {&kernel##_base}
#endif
