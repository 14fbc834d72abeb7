#pragma once

// CUDA's stream, for headers that sources without CUDA include.

struct CUstream_st;

namespace v3dg {
namespace cuda {

// This is cudaStream_t.
using Stream = CUstream_st*;

}  // namespace cuda
}  // namespace v3dg
