#pragma once

// A stream that belongs to one object.

#include "base/device.h"

namespace v3dg {
namespace cuda {

// Owns a stream that does not wait for the default stream.
class OwnStream {
  public:
    OwnStream() {
        check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "cudaStreamCreate");
    }
    // Waits for the work on the stream, which reads memory of the caller, even if a
    // step has failed.
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
