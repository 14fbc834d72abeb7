#pragma once

// An event of CUDA that marks a place in a stream.

#include "base/device.h"

namespace v3dg {
namespace cuda {

// Owns an event without timing. Before it is recorded it counts as happened.
class Event {
  public:
    Event() {
        check(cudaEventCreateWithFlags(&event_, cudaEventDisableTiming),
              "cudaEventCreateWithFlags");
    }
    ~Event() { cudaEventDestroy(event_); }
    Event(const Event&) = delete;
    Event& operator=(const Event&) = delete;

    // Marks the end of what has been enqueued on `stream` so far.
    void record(cudaStream_t stream) { check(cudaEventRecord(event_, stream), "cudaEventRecord"); }
    // Makes what is enqueued on `stream` from now on wait for the event. The host does not wait.
    void hold_back(cudaStream_t stream) const {
        check(cudaStreamWaitEvent(stream, event_, 0), "cudaStreamWaitEvent");
    }
    // Returns at once. `work` names the work before the event in the error of a kernel that failed.
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
