// What the modules ask of arrays that come from Python.
#pragma once

#include <cstddef>
#include <stdexcept>

inline void check(bool holds, const char *message) {
    if (!holds) throw std::invalid_argument(message);
}

template <class Array, class... Sizes>
bool is(const Array &array, Sizes... sizes) {
    size_t axis = 0;
    return (... && (array.shape(axis++) == size_t(sizes)));
}
