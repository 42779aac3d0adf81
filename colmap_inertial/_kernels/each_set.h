// For sources that are compiled once for each instruction set, which SIMD names. They include no standard headers but
// C's: an inline function of C++'s, compiled here for AVX-512, could otherwise be the copy that the linker keeps for
// everybody.
#pragma once

#include <string.h>

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define TEXT_(a) #a
#define TEXT(a) TEXT_(a)

// Before a loop whose iterations do not depend on each other, which compilers cannot see of pointers.
#if defined(__clang__)
#define INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#else
#define INDEPENDENT _Pragma("GCC ivdep")
#endif

// Of a vector of floating-point numbers.
#if defined(__AVX512F__)
constexpr int VECTOR_BYTES = 64;
#elif defined(__AVX2__)
constexpr int VECTOR_BYTES = 32;
#else
constexpr int VECTOR_BYTES = 16;
#endif
