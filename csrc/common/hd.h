// VN_HD marks functions shared by the CPU and CUDA, so that the tests on the CPU cover the formulas of the GPU. They
// have internal linkage, because the files compiled per instruction set must not share inline functions (see simd.h).
#pragma once

#ifdef __CUDACC__
#define VN_HD static inline __host__ __device__
#else
#define VN_HD static inline
#endif
