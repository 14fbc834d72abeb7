#pragma once

// Reads a part of a file, and hashes it at the same time.

#include <future>

#include "base/mutex.h"
#include "base/span.h"
#include "io/blake2b.h"
#include "io/file.h"

namespace v3dg {

// What is hashed: all bytes in order, or the hashes of pieces (HashOfPieces).
enum class HashOf { bytes, pieces };

// Reads a part of a file that ends with its own hash, and computes the hash at the same
// time. Two threads process a large part, so that the caller can use its beginning
// while the rest is hashed. A small part is read and hashed by the threads that wait
// for it.
class HashedRead {
  public:
    static constexpr size_t kLargeBytes = size_t(4) << 20;

    // Fills the message, beginning at message[num_before], with the bytes of the file
    // that start at `offset`. The bytes before, which the caller has set, are hashed,
    // too. The last bytes of the message are the hash of all bytes before them. The
    // memory of the message must outlive this object.
    HashedRead(File file, size_t offset, Span<uint8_t> message, size_t num_before, HashOf hash_of);
    HashedRead(const HashedRead&) = delete;

    // Waits until everything has been read. Returns false if the file ended early.
    // Throws std::system_error if it cannot be read.
    bool wait() { return read_.get(); }
    // Waits until everything has been hashed. Returns whether the hash at the end of
    // the message is correct.
    bool is_sound();

  private:
    bool read() V3DG_EXCLUDES(busy_);
    bool hash() V3DG_EXCLUDES(busy_);
    void report(size_t num_read, bool is_over) V3DG_EXCLUDES(busy_);
    size_t wait_for_more(size_t num_known) V3DG_EXCLUDES(busy_);

    const File file_;
    const size_t offset_;
    const Span<uint8_t> bytes_;          // memory to read into
    const Span<const uint8_t> message_;  // bytes to hash
    const HashOf hash_of_;

    Mutex busy_;
    Condition has_more_;
    size_t num_read_ V3DG_GUARDED_BY(busy_) = 0;
    bool is_over_ V3DG_GUARDED_BY(busy_) = false;
    // These must be the last members, because their destructors wait for threads that
    // use the members above.
    std::shared_future<bool> read_;
    std::shared_future<bool> is_sound_;
};

}  // namespace v3dg
