#pragma once

// The error for a lack of device memory, for all sources that allocate it.

#include <cstddef>

namespace v3dg {
namespace cuda {

// Throws OutOfMemory (device.h) with the requested and the free bytes.
[[noreturn]] void fail_out_of_memory(size_t requested_bytes);

}  // namespace cuda
}  // namespace v3dg
