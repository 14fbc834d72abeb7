#pragma once

// A CUDA event, which marks a position in a stream.

#include "base/device.h"

namespace v3dg {
namespace cuda {

// Owns an event that does not measure time. An event that was never recorded counts as
// completed.
class Event {
  public:
    Event() {
        check(cudaEventCreateWithFlags(&event_, cudaEventDisableTiming),
              "cudaEventCreateWithFlags");
    }
    ~Event() { cudaEventDestroy(event_); }
    Event(const Event&) = delete;
    Event& operator=(const Event&) = delete;

    // Marks the end of the work that was enqueued on `stream` so far.
    void record(cudaStream_t stream) { check(cudaEventRecord(event_, stream), "cudaEventRecord"); }
    // Makes later work on `stream` wait for the event. The host does not wait.
    void hold_back(cudaStream_t stream) const {
        check(cudaStreamWaitEvent(stream, event_, 0), "cudaStreamWaitEvent");
    }
    // Returns whether the device has reached the event. Does not wait. Throws if
    // earlier work failed; `work` names that work in the error text.
    bool has_happened(const char* work) const {
        const cudaError_t state = cudaEventQuery(event_);
        if (state == cudaErrorNotReady) return false;
        check(state, work);
        return true;
    }

  private:
    cudaEvent_t event_ = nullptr;
};

}  // namespace cuda
}  // namespace v3dg
