// What the modules ask of arrays and numbers that come from Python.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstddef>
#include <stdexcept>
#include <thread>

#if defined(__linux__)
#include <sched.h>
#endif

namespace nb = nanobind;

template <class T, int N>
using Of = nb::ndarray<T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;
template <class T, int N>
using In = Of<const T, N>;

inline void check(bool holds, const char *message) {
    if (!holds) throw std::invalid_argument(message);
}

template <class Array, class... Sizes>
bool is(const Array &array, Sizes... sizes) {
    size_t axis = 0;
    return (... && (array.shape(axis++) == size_t(sizes)));
}

// The number of threads; of 0, as many as the process may run on.
inline int threads_or_all(int threads) {
    check(threads >= 0, "threads: negative");
    if (threads > 0) return threads;
#if defined(__linux__)
    cpu_set_t set;
    if (sched_getaffinity(0, sizeof set, &set) == 0) return std::max(1, CPU_COUNT(&set));
#endif
    return int(std::max(1u, std::thread::hardware_concurrency()));
}
