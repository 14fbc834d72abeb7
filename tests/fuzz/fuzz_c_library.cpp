// Coverage-guided fuzzer of the C library, for libFuzzer (tests/fuzz/run.py builds and
// starts it). Inputs that begin with "{" are scenes, which refer to the bundle a.v3dg in
// the working folder. Other inputs are bundles, and their hashes are corrected.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <string_view>
#include <vector>

#include <v3dg.h>

#include "c_interface/bundle_header.h"
#include "c_interface/fault.h"
#include "io/blake2b.h"

namespace {

constexpr uint64_t kMostGaussians = 1 << 16;
constexpr uint32_t kMostPages = 16;

void require(bool condition) {
    if (!condition) std::abort();
}

void require_message() {
    const std::string_view text = v3dg_last_error();
    require(!text.empty());
    for (const char c : text) require(static_cast<unsigned char>(c) >= ' ' && c != 0x7f);
}

uint64_t number_at(const std::string& data, uint64_t place) {
    uint64_t number = 0;
    std::memcpy(&number, data.data() + place, sizeof number);
    return number;
}

// Writes the hash of `message` to an address.
void put_hash(const std::string& message, std::string& data, uint64_t place) {
    v3dg::Blake2b hash;
    hash.add(reinterpret_cast<const unsigned char*>(message.data()), message.size());
    const v3dg::PageHash digest = hash.digest();
    std::memcpy(data.data() + place, digest.data(), digest.size());
}

void put_hash_of_pieces(const std::string& message, std::string& data, uint64_t place) {
    std::string digests;
    for (uint64_t first = 0; first < message.size(); first += v3dg::kHashPieceBytes) {
        digests.resize(digests.size() + v3dg::kPageHashBytes);
        put_hash(message.substr(first, v3dg::kHashPieceBytes), digests,
                 digests.size() - v3dg::kPageHashBytes);
    }
    put_hash(digests, data, place);
}

// Corrects the hashes of the file and of all pages that the header describes.
void make_hashes_fit(std::string& data) {
    if (data.size() < 8) return;
    const uint64_t header_bytes = number_at(data, 0);
    if (header_bytes == 0 || header_bytes > data.size() - 8) return;
    v3dg::BundleHeader header;
    try {
        header = v3dg::read_bundle_header("", std::string_view(data).substr(8, header_bytes),
                                          8 + header_bytes, data.size());
    } catch (const v3dg::Fault&) {
        return;
    }
    const uint64_t start = header.data_start;
    const uint64_t pages_bytes = header.pages_bytes();
    const auto page_end = [&](uint64_t page) {
        if (page + 1 == header.num_pages) return pages_bytes;
        return number_at(data, start + header.parts.at("pages.offset").first + 8 * (page + 1));
    };
    for (uint64_t page = 0, first = 0; page < header.num_pages; ++page) {
        const uint64_t end = page_end(page);
        if (end < first || end > pages_bytes) return;
        put_hash(data.substr(start + first, end - first), data,
                 start + header.parts.at("pages.hash").first + v3dg::kPageHashBytes * page);
        first = end;
    }
    const v3dg::FilePart hash = header.parts.at("hash");
    const std::string covered =
        data.substr(0, start) + data.substr(start + pages_bytes, hash.first - pages_bytes);
    if (header.version > 2)
        put_hash_of_pieces(covered, data, start + hash.first);
    else
        put_hash(covered, data, start + hash.first);
}

void write_file(const char* path, const std::string& data) {
    std::FILE* file = std::fopen(path, "wb");
    require(file != nullptr);
    require(std::fwrite(data.data(), 1, data.size(), file) == data.size());
    require(std::fclose(file) == 0);
}

struct Rows {
    std::vector<float> means, quaternions, scales, opacities, sh;
    v3dg_gaussians memory;

    explicit Rows(uint64_t count)
        : means(3 * count + 1),
          quaternions(4 * count + 1),
          scales(3 * count + 1),
          opacities(count + 1),
          sh(48 * count + 1),
          memory{means.data(),
                 quaternions.data(),
                 scales.data(),
                 opacities.data(),
                 sh.data(),
                 count,
                 3} {}
};

void read_pages(const v3dg_scene* scene, uint32_t bundle) {
    v3dg_bundle_info info;
    require(v3dg_get_bundle_info(scene, bundle, &info) == V3DG_OK);
    for (uint32_t page = 0; page < info.num_pages && page < kMostPages; ++page) {
        v3dg_page_info place;
        require(v3dg_get_page_info(scene, bundle, page, &place) == V3DG_OK);
        if (place.num_gaussians > kMostGaussians) continue;
        Rows rows(place.num_gaussians);
        if (v3dg_read_gaussians(scene, bundle, page, &rows.memory) != V3DG_OK) require_message();
    }
}

void read_cut(const v3dg_scene* scene) {
    const double eye[3] = {0, -3, 0.5}, target[3] = {0, 0, 0}, up[3] = {0, 0, 1};
    v3dg_camera camera;
    require(v3dg_look_at(eye, target, up, 0.8, 64, 48, 0.01, &camera) == V3DG_OK);
    v3dg_rule rule = V3DG_DEFAULT_RULE;
    rule.fade = 1.5;
    v3dg_cut* cut = nullptr;
    require(v3dg_select(scene, &camera, 1, &rule, &cut) == V3DG_OK);
    if (cut->num_gaussians <= kMostGaussians) {
        Rows rows(cut->num_gaussians);
        if (v3dg_read_cut(scene, cut, eye, &rows.memory) != V3DG_OK) require_message();
    }
    v3dg_free_cut(cut);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    std::string content(reinterpret_cast<const char*>(data), size);
    const bool is_scene = !content.empty() && content[0] == '{';
    const char* path = is_scene ? "fuzz.json" : "fuzz.v3dg";
    if (!is_scene) make_hashes_fit(content);
    write_file(path, content);
    v3dg_scene* scene = nullptr;
    if (v3dg_open(path, &scene) != V3DG_OK) {
        require(scene == nullptr);
        require_message();
        return 0;
    }
    v3dg_scene_info info;
    require(v3dg_get_scene_info(scene, &info) == V3DG_OK);
    for (uint32_t bundle = 0; bundle < info.num_bundles && bundle < 4; ++bundle)
        read_pages(scene, bundle);
    read_cut(scene);
    v3dg_close(scene);
    return 0;
}
