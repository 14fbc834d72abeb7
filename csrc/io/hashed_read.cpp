#include "io/hashed_read.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "base/parallel_for.h"

namespace v3dg {

namespace {

constexpr size_t kPieceBytes = size_t(1) << 20;
constexpr size_t kPiecesAhead = 8;                  // that the disk is asked for together
constexpr size_t kNeededBefore = size_t(64) << 10;  // of the coarsest page, which is in front of the tables

}  // namespace

HashedRead::HashedRead(PosixFile file, size_t offset, Span<uint8_t> message, size_t num_before)
    : file_(std::move(file)),
      offset_(offset),
      bytes_{message.data + num_before, message.size - num_before},
      message_{message.data, message.size - kPageHashBytes} {
    const size_t first = offset - std::min(offset, kNeededBefore);
    file_.expect(first, offset - first + std::min(bytes_.size, kPieceBytes));
    const auto how = is_large() ? std::launch::async : std::launch::deferred;
    read_ = std::async(how, [this] { return read(); }).share();
    hash_ = std::async(how, [this] { return hash(); });
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
            is_whole =
                file_.read_at(offset_ + done, reinterpret_cast<char*>(bytes_.data) + done, size) == size;
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

PageHash HashedRead::hash() {
    Blake2b hash;
    const size_t num_before = static_cast<size_t>(bytes_.data - message_.data);
    hash.add(message_.data, num_before);
    for (size_t done = 0; num_before + done < message_.size;) {
        const size_t end = std::min(wait_for_more(done), message_.size - num_before);
        if (end == done) break;  // the file ended, of which wait() tells
        hash.add(bytes_.data + done, end - done);
        done = end;
    }
    return hash.digest();
}

std::optional<PageHash> HashedRead::digest() {
    const std::lock_guard<std::mutex> lock(busy_);
    return digest_;
}

void HashedRead::set_digest(const PageHash& digest) {
    const std::lock_guard<std::mutex> lock(busy_);
    digest_ = digest;
}

bool HashedRead::is_sound() {
    if (!digest()) {
        read_.wait();
        set_digest(hash_.get());
    }
    const PageHash found = *digest();
    return std::equal(found.begin(), found.end(), message_.end());
}

void HashedRead::hash_small(Span<HashedRead* const> reads) {
    std::vector<HashedRead*> small;
    for (HashedRead* read : reads)
        if (!read->is_large() && !read->digest()) small.push_back(read);
    parallel_for((small.size() + kHashedTogether - 1) / kHashedTogether, 1, [&](size_t k) {
        Span<const uint8_t> messages[kHashedTogether];
        PageHash digests[kHashedTogether];
        const size_t first = k * kHashedTogether, count = std::min(kHashedTogether, small.size() - first);
        for (size_t i = 0; i < count; ++i) messages[i] = small[first + i]->message_;
        blake2b({messages, count}, digests);
        for (size_t i = 0; i < count; ++i) small[first + i]->set_digest(digests[i]);
    });
}

}  // namespace v3dg
