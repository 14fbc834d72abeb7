#include "io/hashed_read.h"

#include <algorithm>
#include <utility>

namespace v3dg {

namespace {

constexpr size_t kPieceBytes = size_t(1) << 20;
constexpr size_t kPiecesAhead = 8;  // number of pieces that are requested from the disk
                                    // together
// The usual size of the coarsest page, which comes before the tables in the file and is
// needed next.
constexpr size_t kNeededBefore = size_t(64) << 10;

}  // namespace

HashedRead::HashedRead(File file, size_t offset, Span<uint8_t> message, size_t num_before,
                       HashOf hash_of)
    : file_(std::move(file)),
      offset_(offset),
      bytes_{message.data + num_before, message.size - num_before},
      message_{message.data, message.size - kPageHashBytes},
      hash_of_(hash_of) {
    const size_t first = offset - std::min(offset, kNeededBefore);
    file_.expect(first, offset - first + std::min(bytes_.size, kPieceBytes));
    const auto policy = bytes_.size >= kLargeBytes ? std::launch::async : std::launch::deferred;
    read_ = std::async(policy, [this] { return read(); }).share();
    is_sound_ = std::async(policy, [this] { return hash(); }).share();
}

bool HashedRead::read() {
    bool is_whole = true;
    std::exception_ptr error;
    size_t num_expected = 0;
    size_t num_read = 0;
    try {
        for (size_t done = 0; done < bytes_.size && is_whole; done += kPieceBytes) {
            const size_t end = std::min(bytes_.size, done + kPiecesAhead * kPieceBytes);
            for (; num_expected < end; num_expected += kPieceBytes)
                file_.expect(offset_ + num_expected,
                             std::min(kPieceBytes, bytes_.size - num_expected));
            const size_t size = std::min(kPieceBytes, bytes_.size - done);
            is_whole = file_.read_at(offset_ + done, reinterpret_cast<char*>(bytes_.data) + done,
                                     size) == size;
            num_read = done + size;
            report(num_read, false);
        }
    } catch (const std::system_error&) {
        error = std::current_exception();
    }
    report(num_read, true);
    if (error) std::rethrow_exception(error);
    return is_whole;
}

void HashedRead::report(size_t num_read, bool is_over) {
    const MutexLock lock(busy_);
    num_read_ = num_read;
    is_over_ = is_over;
    has_more_.notify_one();
}

// Waits until more than `num_known` bytes have been read, or reading has ended. Returns
// the number of bytes that have been read.
size_t HashedRead::wait_for_more(size_t num_known) {
    const MutexLock lock(busy_);
    while (!is_over_ && num_read_ <= num_known) has_more_.wait(busy_);
    return num_read_;
}

bool HashedRead::hash() {
    Blake2b of_bytes;
    HashOfPieces of_pieces(message_);
    const size_t num_before = static_cast<size_t>(bytes_.data - message_.data);
    for (size_t done = 0, end = num_before;;) {
        if (hash_of_ == HashOf::bytes) of_bytes.add(message_.data + done, end - done);
        if (hash_of_ == HashOf::pieces) of_pieces.add_until(end);
        done = end;
        if (done == message_.size) break;
        end = num_before + std::min(wait_for_more(done - num_before), message_.size - num_before);
        if (end == done) break;  // the file ended early, which wait() reports
    }
    // The digest is compared with the hash at the end of the message, so wait for it.
    wait_for_more(bytes_.size - 1);
    const PageHash digest = hash_of_ == HashOf::bytes ? of_bytes.digest() : of_pieces.digest();
    return std::equal(digest.begin(), digest.end(), message_.end());
}

bool HashedRead::is_sound() {
    read_.wait();
    return is_sound_.get();
}

}  // namespace v3dg
