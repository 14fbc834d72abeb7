#pragma once

#include <condition_variable>
#include <future>
#include <mutex>

#include "base/span.h"
#include "io/blake2b.h"
#include "io/posix_file.h"

namespace v3dg {

// A part of a file that is read and hashed at the same time, where it is large on threads of its own: the
// caller may look at it while it is still hashed. Where it is small, in the threads that wait.
class HashedRead {
  public:
    // What lies at `offset` comes to `bytes`, and is hashed behind what is in `before`. Both stay where they
    // are as long as this lives.
    HashedRead(PosixFile file, Span<const uint8_t> before, size_t offset, Span<uint8_t> bytes);
    HashedRead(const HashedRead&) = delete;

    // Waits until all is read. Throws std::system_error; false where the file ends before.
    bool wait() { return read_.get(); }
    // Of all, once it is read.
    PageHash digest();

  private:
    bool read();
    PageHash hash();
    size_t wait_for_more(size_t than);

    const PosixFile file_;
    const Span<const uint8_t> before_;
    const size_t offset_;
    const Span<uint8_t> bytes_;

    std::mutex busy_;
    std::condition_variable has_more_;
    size_t num_read_ = 0;
    bool is_over_ = false;
    // Last, for they wait for the threads, which use all of the above.
    std::shared_future<bool> read_;
    std::future<PageHash> hash_;
};

}  // namespace v3dg
