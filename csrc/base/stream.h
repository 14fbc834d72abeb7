#pragma once

struct CUstream_st;

namespace v3dg {
namespace cuda {

// cudaStream_t, for headers that sources without CUDA include.
using Stream = CUstream_st*;

}  // namespace cuda
}  // namespace v3dg
