// VN_HD marks arithmetic shared by CPU and CUDA: one formula for both worlds, so that the CPU's tests exercise the
// GPU's. Internal linkage, because the files compiled per instruction set must not share inline functions (see simd.h).
#pragma once

#ifdef __CUDACC__
#define VN_HD static inline __host__ __device__
#else
#define VN_HD static inline
#endif
