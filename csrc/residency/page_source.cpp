// Reads pages in three steps. First, adjacent pages are read in one system call. If
// that fails, single pages are read, so that the error names the right page. Finally,
// all hashes are verified together.

#include "residency/page_source.h"

#include <algorithm>
#include <cassert>
#include <cerrno>
#include <cstring>

#include "io/blake2b.h"
#include "quantize/quantize.h"

namespace v3dg {

PageSource::PageSource(const ClusterTable& table, int sh_degree, PageCodec codec)
    : sh_degree_(sh_degree), codec_(codec), offset_(table.offset.begin(), table.offset.end()) {
    first_cluster_.assign(table.num_pages() + 1, 0);
    for (size_t c = 0; c < table.num_clusters(); ++c) first_cluster_[table.page_of(c) + 1] = c + 1;
}

Span<const int64_t> PageSource::clusters(size_t page) const {
    const size_t first = first_cluster_[page], last = first_cluster_[page + 1];
    return {offset_.data() + first, last - first + 1};
}

GaussianRows<const float> PageSource::rows(size_t page, const unsigned char* bytes,
                                           std::vector<float>& decoded) const {
    const size_t count = num_rows(page);
    if (codec_ == PageCodec::float32) return rows_of_page(bytes, count, sh_degree_);
    std::vector<int64_t> offset;
    for (const int64_t row : clusters(page)) offset.push_back(row - first_row(page));
    decoded.resize(count * (11 + 3 * num_sh_bases(sh_degree_)));
    const GaussianRows<const float> rows =
        rows_of_page(reinterpret_cast<const unsigned char*>(decoded.data()), count, sh_degree_);
    const auto writable = [](const float* values) { return const_cast<float*>(values); };
    cpu::decode_page(
        {{offset.data(), offset.size()}, reinterpret_cast<const uint32_t*>(bytes), sh_degree_},
        {.means = writable(rows.means),
         .quats = writable(rows.quats),
         .scales = writable(rows.scales),
         .opacities = writable(rows.opacities),
         .sh = writable(rows.sh),
         .size = count,
         .sh_degree = sh_degree_});
    return rows;
}

FilePages::FilePages(const ClusterTable& table, int sh_degree, PageCodec codec, std::string name,
                     int descriptor, Span<const int64_t> place, Span<const uint8_t> hash,
                     Fetch fetch)
    : PageSource(table, sh_degree, codec),
      name_(std::move(name)),
      file_(File::duplicate(descriptor)),
      place_(place.begin(), place.end()),
      hash_(hash.begin(), hash.end()),
      fetch_(std::move(fetch)) {}

static void read_one(const File& file, Span<const int64_t> places, PageReading& reading,
                     const std::function<std::string(size_t)>& name_of) {
    const size_t page = reading.page;
    const auto size = static_cast<size_t>(places[page + 1] - places[page]);
    try {
        if (file.read_at(places[page], reinterpret_cast<char*>(reading.bytes), size) < size)
            reading.error.emplace(name_of(page) + " is missing; the file was truncated", true);
    } catch (const std::system_error& error) {
        reading.error.emplace(name_of(page) + ": " + error.code().message(), false,
                              error.code().value());
    }
}

// A gap between two pages of at most this size is read and discarded, which is faster
// than a second system call. It is the size of one or two pages.
constexpr size_t kMostSkippedBytes = size_t(32) << 10;

// Returns the end of the pages that are read in the same system call as page `first`.
static size_t end_of_run(Span<const int64_t> places, Span<const PageReading> pages, size_t first) {
    size_t end = first + 1;
    while (end < pages.size &&
           static_cast<size_t>(places[pages[end].page] - places[pages[end - 1].page + 1]) <=
               kMostSkippedBytes)
        ++end;
    return end;
}

static void read_run(const File& file, Span<const int64_t> places, Span<PageReading> run,
                     const std::function<std::string(size_t)>& name_of) {
    char skipped[kMostSkippedBytes];
    FilePiece pieces[2 * kMostPagesTogether];
    size_t count = 0;
    const int64_t first = places[run[0].page];
    int64_t place = first;
    const auto add = [&](void* bytes, int64_t end) {
        if (end > place) pieces[count++] = {bytes, static_cast<size_t>(end - place)};
        place = end;
    };
    for (const PageReading& reading : run) {
        add(skipped, places[reading.page]);
        add(reading.bytes, places[reading.page + 1]);
    }
    try {
        if (file.read_at(first, {pieces, count}) == static_cast<size_t>(place - first)) return;
    } catch (const std::system_error&) {
        // Read page by page, to find out which page fails, and whether it fails again.
    }
    for (PageReading& reading : run) read_one(file, places, reading, name_of);
}

void read_verified(const File& file, Span<const int64_t> places, const uint8_t* hashes,
                   Span<PageReading> pages, const std::function<std::string(size_t)>& name_of) {
    assert(pages.size <= kMostPagesTogether);
    for (size_t first = 0, end = 0; first < pages.size; first = end) {
        end = end_of_run(places, pages, first);
        read_run(file, places, {pages.data + first, end - first}, name_of);
    }
    Span<const uint8_t> messages[kMostPagesTogether];
    PageReading* read[kMostPagesTogether];
    PageHash digests[kMostPagesTogether];
    size_t count = 0;
    for (PageReading& reading : pages) {
        if (reading.error) continue;
        const int64_t begin = places[reading.page];
        const int64_t end = places[reading.page + 1];
        messages[count] = {reading.bytes, static_cast<size_t>(end - begin)};
        read[count++] = &reading;
    }
    blake2b({messages, count}, digests);
    for (size_t k = 0; k < count; ++k) {
        const size_t page = read[k]->page;
        if (!std::equal(digests[k].begin(), digests[k].end(), hashes + kPageHashBytes * page))
            read[k]->error.emplace(name_of(page) + ": the hash does not match; " + kDamaged, true);
    }
}

void PageSource::read(size_t page, unsigned char* bytes) const {
    PageReading reading{page, bytes, {}};
    read_pages({&reading, 1});
    if (reading.error) throw PageError(*reading.error);
}

void FilePages::expect(Span<const PageReading> pages) const {
    if (fetch_) return;
    const Span<const int64_t> places{place_.data(), place_.size()};
    for (size_t first = 0, end = 0; first < pages.size; first = end) {
        end = end_of_run(places, pages, first);
        const int64_t begin = places[pages[first].page];
        file_.expect(begin, places[pages[end - 1].page + 1] - begin);
    }
}

// Fetches the pages. Returns whether they can be read now. If not, sets their errors.
bool FilePages::fetch(Span<PageReading> pages) const {
    int64_t places[2 * kMostPagesTogether];
    size_t count = 0;
    for (const PageReading& reading : pages) {
        places[count++] = place_[reading.page];
        places[count++] = place_[reading.page + 1];
    }
    std::string problem = fetch_({places, count});
    if (problem.empty()) return true;
    if (problem.rfind(name_ + ": ", 0) == 0) problem.erase(0, name_.size() + 2);
    for (PageReading& reading : pages)
        reading.error.emplace(name_of(reading.page) + ": " + problem, false, EIO);
    return false;
}

void FilePages::read_pages(Span<PageReading> pages) const {
    if (fetch_ && !fetch(pages)) return;
    read_verified(file_, {place_.data(), place_.size()}, hash_.data(), pages,
                  [this](size_t page) { return name_of(page); });
    if (codec() == PageCodec::float32) return;
    for (PageReading& reading : pages) {
        const PageCodes<const uint32_t> codes{
            clusters(reading.page), reinterpret_cast<const uint32_t*>(reading.bytes), sh_degree()};
        for (size_t c = 0; c < codes.num_clusters() && !reading.error; ++c) {
            const uint32_t* words = codes.ranges(c);
            if (!are_valid(*reinterpret_cast<const ClusterCode*>(words),
                           reinterpret_cast<const uint16_t*>(words + sizeof(ClusterCode) / 4),
                           sh_degree()))
                reading.error.emplace(name_of(reading.page) + ": cluster " + std::to_string(c) +
                                          " has ranges that are not finite; " + kDamaged,
                                      true);
        }
    }
}

static size_t floats_of_gaussian(int sh_degree) { return 11 + 3 * num_sh_bases(sh_degree); }

size_t MemoryPages::num_bytes(size_t page) const {
    return sizeof(float) * floats_of_gaussian(sh_degree()) * num_rows(page);
}

void MemoryPages::read_pages(Span<PageReading> pages) const {
    for (const PageReading& reading : pages) copy(reading.page, reading.bytes);
}

void MemoryPages::copy(size_t page, unsigned char* bytes) const {
    const size_t first = first_row(page), count = num_rows(page);
    const auto add = [&](const float* rows, size_t width) {
        if (count > 0) std::memcpy(bytes, rows + first * width, sizeof(float) * count * width);
        bytes += sizeof(float) * count * width;
    };
    add(rows_.means, 3);
    add(rows_.quats, 4);
    add(rows_.scales, 3);
    add(rows_.opacities, 1);
    add(rows_.sh, rows_.num_sh());
}

GaussianRows<const float> rows_of_page(const unsigned char* bytes, size_t num_gaussians,
                                       int sh_degree) {
    const float* means = reinterpret_cast<const float*>(bytes);
    const float* quats = means + 3 * num_gaussians;
    const float* scales = quats + 4 * num_gaussians;
    const float* opacities = scales + 3 * num_gaussians;
    return {.means = means,
            .quats = quats,
            .scales = scales,
            .opacities = opacities,
            .sh = opacities + num_gaussians,
            .size = num_gaussians,
            .sh_degree = sh_degree};
}

}  // namespace v3dg
