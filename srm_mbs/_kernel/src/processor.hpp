// Versions of a function for the instructions that a processor has.
#pragma once

#include <cstddef>  // defines __GLIBC__ with glibc

// A function with this attribute is compiled twice, for every x86-64 and for processors with AVX2
// and fused multiply-adds (x86-64-v3); the dynamic loader takes the one that fits.  Their results
// differ by rounding.  Only the function is compiled so, with what is inlined into it: types are
// laid out and memory is aligned as everywhere else.  Other compilers and platforms have one
// version: NEON is part of every arm64, and the loaders of macOS and musl choose none.  The thread
// sanitizer instruments the choice, which the loader makes before the sanitizer can be called.
#if !defined(__SANITIZE_THREAD__) && defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && __GNUC__ >= 12 && \
    !defined(__clang__)
#define SRM_FOR_PROCESSOR __attribute__((target_clones("default", "arch=x86-64-v3")))
#else
#define SRM_FOR_PROCESSOR
#endif
