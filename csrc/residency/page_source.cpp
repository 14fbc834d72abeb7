#include "residency/page_source.h"

#include <algorithm>
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
    const auto written = [](const float* to) { return const_cast<float*>(to); };
    cpu::decode_page({{offset.data(), offset.size()}, reinterpret_cast<const uint32_t*>(bytes), sh_degree_},
                     {written(rows.means), written(rows.quats), written(rows.scales), written(rows.opacities),
                      written(rows.sh), count, sh_degree_});
    return rows;
}

FilePages::FilePages(const ClusterTable& table, int sh_degree, PageCodec codec, std::string name,
                     int descriptor, Span<const int64_t> place, Span<const uint8_t> hash)
    : PageSource(table, sh_degree, codec),
      name_(std::move(name)),
      file_(PosixFile::duplicate(descriptor)),
      place_(place.begin(), place.end()),
      hash_(hash.begin(), hash.end()) {}

void read_verified(const PosixFile& file, size_t place, size_t size, const uint8_t* hash,
                   const std::string& where, unsigned char* bytes) {
    size_t got = 0;
    try {
        got = file.read_at(place, reinterpret_cast<char*>(bytes), size);
    } catch (const std::system_error& error) {
        throw PageError(where + ": " + error.code().message(), false, error.code().value());
    }
    if (got < size) throw PageError(where + " is not there; the file was truncated", true);
    const PageHash digest = blake2b({bytes, size});
    if (!std::equal(digest.begin(), digest.end(), hash))
        throw PageError(where + ": the hash does not match; " + kDamaged, true);
}

void FilePages::read(size_t page, unsigned char* bytes) const {
    const std::string where = name_ + ": page " + std::to_string(page);
    read_verified(file_, place_[page], num_bytes(page), hash_.data() + kPageHashBytes * page, where, bytes);
    if (codec() == PageCodec::float32) return;
    const PageCodes<const uint32_t> codes{clusters(page), reinterpret_cast<const uint32_t*>(bytes),
                                          sh_degree()};
    for (size_t c = 0; c < codes.num_clusters(); ++c) {
        const uint32_t* words = codes.ranges(c);
        if (!are_valid(*reinterpret_cast<const ClusterCode*>(words),
                       reinterpret_cast<const uint16_t*>(words + sizeof(ClusterCode) / 4), sh_degree()))
            throw PageError(
                where + ": cluster " + std::to_string(c) + " has ranges that are not finite; " + kDamaged,
                true);
    }
}

static size_t floats_of_gaussian(int sh_degree) { return 11 + 3 * num_sh_bases(sh_degree); }

size_t MemoryPages::num_bytes(size_t page) const {
    return sizeof(float) * floats_of_gaussian(sh_degree()) * num_rows(page);
}

void MemoryPages::read(size_t page, unsigned char* bytes) const {
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

GaussianRows<const float> rows_of_page(const unsigned char* bytes, size_t num_gaussians, int sh_degree) {
    const float* means = reinterpret_cast<const float*>(bytes);
    const float* quats = means + 3 * num_gaussians;
    const float* scales = quats + 4 * num_gaussians;
    const float* opacities = scales + 3 * num_gaussians;
    return {means, quats, scales, opacities, opacities + num_gaussians, num_gaussians, sh_degree};
}

}  // namespace v3dg
