#pragma once

// A CUDA stream that one object owns.

#include "base/device.h"

namespace v3dg {
namespace cuda {

// Owns a stream that does not synchronise with the default stream.
class OwnStream {
  public:
    OwnStream() {
        check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "cudaStreamCreate");
    }
    // Waits for the stream, because its work may still read memory of the owner, even
    // after an error.
    ~OwnStream() {
        cudaStreamSynchronize(stream_);
        cudaStreamDestroy(stream_);
    }
    OwnStream(const OwnStream&) = delete;
    OwnStream& operator=(const OwnStream&) = delete;
    cudaStream_t get() const { return stream_; }

  private:
    cudaStream_t stream_ = nullptr;
};

}  // namespace cuda
}  // namespace v3dg
