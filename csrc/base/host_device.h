#pragma once

// V3DG_HD marks a function that is compiled for the host and, by nvcc, for devices.
#ifdef __CUDACC__
#define V3DG_HD __host__ __device__
#else
#define V3DG_HD
#endif

#define V3DG_INLINE inline __attribute__((always_inline))
