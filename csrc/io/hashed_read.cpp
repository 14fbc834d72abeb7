#include "io/hashed_read.h"

#include <algorithm>
#include <utility>

namespace v3dg {

namespace {

constexpr size_t kPieceBytes = size_t(1) << 20;
constexpr size_t kPiecesAhead = 8;  // that the disk is asked for together
constexpr size_t kNeededBefore = size_t(64)
                                 << 10;  // of the coarsest page, which is in front of the tables

}  // namespace

HashedRead::HashedRead(PosixFile file, size_t offset, Span<uint8_t> message, size_t num_before,
                       HashOf how)
    : file_(std::move(file)),
      offset_(offset),
      bytes_{message.data + num_before, message.size - num_before},
      message_{message.data, message.size - kPageHashBytes},
      how_(how) {
    const size_t first = offset - std::min(offset, kNeededBefore);
    file_.expect(first, offset - first + std::min(bytes_.size, kPieceBytes));
    const auto when = bytes_.size >= kLargeBytes ? std::launch::async : std::launch::deferred;
    read_ = std::async(when, [this] { return read(); }).share();
    is_sound_ = std::async(when, [this] { return hash(); }).share();
}

bool HashedRead::read() {
    bool is_whole = true;
    std::exception_ptr error;
    size_t expected = 0;
    try {
        for (size_t done = 0; done < bytes_.size && is_whole; done += kPieceBytes) {
            for (; expected < std::min(bytes_.size, done + kPiecesAhead * kPieceBytes);
                 expected += kPieceBytes)
                file_.expect(offset_ + expected, std::min(kPieceBytes, bytes_.size - expected));
            const size_t size = std::min(kPieceBytes, bytes_.size - done);
            is_whole = file_.read_at(offset_ + done, reinterpret_cast<char*>(bytes_.data) + done,
                                     size) == size;
            const std::lock_guard<std::mutex> lock(busy_);
            num_read_ = done + size;
            has_more_.notify_one();
        }
    } catch (const std::system_error&) {
        error = std::current_exception();
    }
    {
        const std::lock_guard<std::mutex> lock(busy_);
        is_over_ = true;
        has_more_.notify_one();
    }
    if (error) std::rethrow_exception(error);
    return is_whole;
}

size_t HashedRead::wait_for_more(size_t than) {
    std::unique_lock<std::mutex> lock(busy_);
    has_more_.wait(lock, [&] { return is_over_ || num_read_ > than; });
    return num_read_;
}

bool HashedRead::hash() {
    Blake2b of_bytes;
    HashOfPieces of_pieces(message_);
    const size_t num_before = static_cast<size_t>(bytes_.data - message_.data);
    for (size_t done = 0, end = num_before;;) {
        if (how_ == HashOf::bytes) of_bytes.add(message_.data + done, end - done);
        if (how_ == HashOf::pieces) of_pieces.add_until(end);
        done = end;
        if (done == message_.size) break;
        end = num_before + std::min(wait_for_more(done - num_before), message_.size - num_before);
        if (end == done) break;  // the file ended, of which wait() tells
    }
    wait_for_more(bytes_.size -
                  1);  // The hash to compare with may be all that is still to be read.
    const PageHash found = how_ == HashOf::bytes ? of_bytes.digest() : of_pieces.digest();
    return std::equal(found.begin(), found.end(), message_.end());
}

bool HashedRead::is_sound() {
    read_.wait();
    return is_sound_.get();
}

}  // namespace v3dg
