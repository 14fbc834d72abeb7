#pragma once

// CUDA's stream type, for headers that are also included by sources without CUDA.

struct CUstream_st;

namespace v3dg {
namespace cuda {

// The same type as cudaStream_t.
using Stream = CUstream_st*;

}  // namespace cuda
}  // namespace v3dg
