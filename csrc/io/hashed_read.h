#pragma once

#include <condition_variable>
#include <future>
#include <mutex>

#include "base/span.h"
#include "io/blake2b.h"
#include "io/posix_file.h"

namespace v3dg {

// How bytes are hashed: one after another, or piece by piece, the hashes of which have the hash.
enum class HashOf { bytes, pieces };

// A part of a file, with its hash behind it, that is read and hashed at the same time, where it is
// large on threads of its own: the caller may look at it while it is still hashed. Where it is
// small, in the threads that wait.
class HashedRead {
  public:
    static constexpr size_t kLargeBytes = size_t(4) << 20;

    // What lies at `offset` comes to `message` behind so many bytes, with which it is hashed: all
    // but the hash at the end. They stay where they are as long as this lives.
    HashedRead(PosixFile file, size_t offset, Span<uint8_t> message, size_t num_before, HashOf how);
    HashedRead(const HashedRead&) = delete;

    // Waits until all is read. Throws std::system_error; false where the file ends before.
    bool wait() { return read_.get(); }
    // Whether all that was read has the hash at its end.
    bool is_sound();

  private:
    bool read();
    bool hash();
    size_t wait_for_more(size_t than);

    const PosixFile file_;
    const size_t offset_;
    const Span<uint8_t> bytes_;          // that are read
    const Span<const uint8_t> message_;  // that is hashed
    const HashOf how_;

    std::mutex busy_;
    std::condition_variable has_more_;
    size_t num_read_ = 0;
    bool is_over_ = false;
    // Last, for they wait for the threads, which use all of the above.
    std::shared_future<bool> read_;
    std::shared_future<bool> is_sound_;
};

}  // namespace v3dg
