#pragma once

// Reads a part of a file and hashes it at the same time.

#include <future>

#include "base/mutex.h"
#include "base/span.h"
#include "io/blake2b.h"
#include "io/file.h"

namespace v3dg {

// The input of the hash: all bytes in order, or the hashes of pieces (HashOfPieces).
enum class HashOf { bytes, pieces };

// Reads a part of a file that ends with its hash, and computes the hash at the same
// time. Two threads process a large part, so the caller can use it while it is still
// being hashed. A small part is read and hashed by the threads that wait for it.
class HashedRead {
  public:
    static constexpr size_t kLargeBytes = size_t(4) << 20;

    // Fills the message from message[num_before] on with the bytes of the file that
    // start at `offset`. The caller has filled the bytes before; they are hashed, too.
    // The last bytes of the message are the hash of all preceding bytes. The memory of
    // the message must outlive this object.
    HashedRead(File file, size_t offset, Span<uint8_t> message, size_t num_before, HashOf hash_of);
    HashedRead(const HashedRead&) = delete;

    // Waits until everything is read. Returns false if the file ended early. Throws
    // std::system_error if the system cannot read it.
    bool wait() { return read_.get(); }
    // Waits until everything is hashed. Returns whether the hash at the end of the
    // message is correct.
    bool is_sound();

  private:
    bool read() V3DG_EXCLUDES(busy_);
    bool hash() V3DG_EXCLUDES(busy_);
    void report(size_t num_read, bool is_over) V3DG_EXCLUDES(busy_);
    size_t wait_for_more(size_t num_known) V3DG_EXCLUDES(busy_);

    const File file_;
    const size_t offset_;
    const Span<uint8_t> bytes_;          // memory to read to
    const Span<const uint8_t> message_;  // bytes to hash
    const HashOf hash_of_;

    Mutex busy_;
    Condition has_more_;
    size_t num_read_ V3DG_GUARDED_BY(busy_) = 0;
    bool is_over_ V3DG_GUARDED_BY(busy_) = false;
    // The last members. Their destructors wait for threads that use the members above.
    std::shared_future<bool> read_;
    std::shared_future<bool> is_sound_;
};

}  // namespace v3dg
