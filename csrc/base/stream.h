#pragma once

// CUDA's stream type, for headers that sources without CUDA include, too.

struct CUstream_st;

namespace v3dg {
namespace cuda {

// The same type as cudaStream_t.
using Stream = CUstream_st*;

}  // namespace cuda
}  // namespace v3dg
