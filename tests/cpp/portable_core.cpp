// Runs the core without Python, and prints a line with a hash for each part. Decisions,
// codes and files must be the same on every system. The picture is printed in steps
// that are larger than the rounding of a compiler. tests/system/test_other_systems.py
// compiles this program for Windows and macOS.

#include <array>
#include <cmath>
#include <cstdio>
#include <stdexcept>
#include <string>
#include <system_error>
#include <vector>

#include "base/parallel_for.h"
#include "cluster/cluster.h"
#include "draw/model.h"
#include "draw/scene_frame.h"
#include "io/blake2b.h"
#include "io/file.h"
#include "io/ply.h"
#include "math/sh.h"
#include "quantize/quantize.h"
#include "select/select.h"

using namespace v3dg;

// Random numbers that are the same on every system.
class Numbers {
  public:
    float next() {
        state_ = state_ * 6364136223846793005u + 1442695040888963407u;
        return static_cast<float>(state_ >> 40) * 0x1p-24f;
    }
    float between(float low, float high) { return low + (high - low) * next(); }

  private:
    uint64_t state_ = 1;
};

static void print_hash(const char* name, const void* bytes, size_t size) {
    Blake2b hash;
    hash.add(static_cast<const unsigned char*>(bytes), size);
    std::printf("%s ", name);
    for (const uint8_t byte : hash.digest()) std::printf("%02x", byte);
    std::printf("\n");
}
template <class T>
static void print_hash(const char* name, const std::vector<T>& values) {
    print_hash(name, values.data(), sizeof(T) * values.size());
}

// Gaussians in a box, with spherical harmonics of degree 1.
struct Cloud {
    static constexpr int kDegree = 1, kNumSh = 4;

    std::vector<float> means, quats, scales, opacities, sh;

    explicit Cloud(size_t count) {
        Numbers numbers;
        for (size_t i = 0; i < count; ++i) {
            for (int k = 0; k < 3; ++k) means.push_back(numbers.between(-1, 1));
            const float x = numbers.between(-0.7f, 0.7f);
            for (const float q : {std::sqrt(1 - x * x), x, 0.0f, 0.0f}) quats.push_back(q);
            for (int k = 0; k < 3; ++k) scales.push_back(numbers.between(0.01f, 0.05f));
            opacities.push_back(numbers.between(0.1f, 1.0f));
            for (int k = 0; k < 3 * kNumSh; ++k) sh.push_back(numbers.between(-0.5f, 0.5f));
        }
    }
    size_t size() const { return opacities.size(); }
    GaussianRows<float> rows() {
        return {.means = means.data(),
                .quats = quats.data(),
                .scales = scales.data(),
                .opacities = opacities.data(),
                .sh = sh.data(),
                .size = size(),
                .sh_degree = kDegree};
    }
    template <class T = float>
    PlyGaussians<T> columns() {
        return {{means.data(), means.size()},
                {quats.data(), quats.size()},
                {scales.data(), scales.size()},
                {opacities.data(), opacities.size()},
                {sh.data(), sh.size()}};
    }
};

// A bundle whose groups replace four clusters by two, level by level.
struct Tree {
    static constexpr size_t kLeaves = 128, kClusterSize = 64;

    std::vector<Ball> ball;
    std::vector<float> weight, filter;
    std::vector<int32_t> level, own, parent;
    std::vector<Box> box;
    std::vector<int64_t> offset{0};
    std::vector<uint8_t> antialiased;

    Tree() {
        for (size_t c = 0; c < kLeaves; ++c) add_cluster(-1);
        size_t first = 0;
        int32_t depth = 1;
        for (size_t count = kLeaves; count > 2; count /= 2) {
            for (size_t c = first; c < first + count; c += 4) add_group(c, depth);
            first += count;
            ++depth;
        }
    }
    size_t num_clusters() const { return own.size(); }
    ClusterTable table() const {
        ClusterTable table{};
        table.ball = {ball.data(), ball.size()};
        table.weight = {weight.data(), weight.size()};
        table.level = {level.data(), level.size()};
        table.own_group = {own.data(), own.size()};
        table.parent_group = {parent.data(), parent.size()};
        table.box = {box.data(), box.size()};
        table.offset = {offset.data(), offset.size()};
        return table;
    }

  private:
    void add_cluster(int32_t group) {
        own.push_back(group);
        parent.push_back(-1);
        box.push_back({{-1.2f, -1.2f, -1.2f}, {1.2f, 1.2f, 1.2f}});
        offset.push_back(offset.back() + static_cast<int64_t>(kClusterSize));
        filter.push_back(group < 0 ? 0.0f : 0.05f);
        antialiased.push_back(group >= 0);
    }
    void add_group(size_t first_child, int32_t depth) {
        const auto group = static_cast<int32_t>(ball.size());
        const float reach = 0.1f * static_cast<float>(depth);
        const float x = -0.9f + 1.8f * static_cast<float>(first_child % 16) / 15.0f;
        ball.push_back({x, 0.1f * x, -x, 2.0f * reach + 1.0f});
        weight.push_back(0.001f * static_cast<float>(depth));
        level.push_back(depth);
        for (size_t c = first_child; c < first_child + 4; ++c) parent[c] = group;
        add_cluster(group);
        add_cluster(group);
    }
};

static Camera camera_at(float x, float z, int width, int height) {
    Camera camera{};
    const double viewmat[16] = {1, 0, 0, -x, 0, 1, 0, 0, 0, 0, 1, z, 0, 0, 0, 1};
    for (int row = 0; row < 3; ++row) {
        for (int k = 0; k < 3; ++k) camera.rotation[3 * row + k] = viewmat[4 * row + k];
        camera.translation[row] = viewmat[4 * row + 3];
    }
    eye_of(viewmat, camera.eye);
    camera.fx = camera.fy = 1.25 * width;
    camera.cx = 0.5 * width;
    camera.cy = 0.5 * height;
    camera.x1 = camera.width = width;
    camera.y1 = camera.height = height;
    camera.near_depth = 0.01;
    return camera;
}

static void split(Cloud& cloud) {
    std::vector<Point> points;
    for (size_t i = 0; i < cloud.size(); ++i)
        points.push_back({cloud.means[3 * i], cloud.means[3 * i + 1], cloud.means[3 * i + 2]});
    const int depth = num_halvings(points.size(), 64);
    const int64_t offset[2] = {0, static_cast<int64_t>(points.size())};
    std::vector<int64_t> order(points.size()), leaf_offset((size_t(1) << depth) + 1);
    cpu::median_split({points.data(), points.size()}, {offset, 2}, depth, 1,
                      {order.data(), order.size()}, {leaf_offset.data(), leaf_offset.size()});
    print_hash("split", order);
}

static void code_page(Cloud& cloud) {
    std::vector<int64_t> offset;
    for (size_t row = 0; row <= 1024; row += 64) offset.push_back(static_cast<int64_t>(row));
    std::vector<uint32_t> words(page_bytes(1024, offset.size() - 1, Cloud::kDegree) / 4);
    GaussianRows<float> rows = cloud.rows();
    rows.size = 1024;
    cpu::encode_page(rows, {{offset.data(), offset.size()}, words.data(), Cloud::kDegree});
    print_hash("codes", words);
    Cloud decoded(1024);
    cpu::decode_page({{offset.data(), offset.size()}, words.data(), Cloud::kDegree},
                     decoded.rows());
    print_hash("decoded means", decoded.means);
    print_hash("decoded sh", decoded.sh);
}

// The instances of a scene in a row, away from the camera.
struct Row {
    std::vector<int32_t> bundle;
    std::vector<double> position, quaternion, scale;
    std::vector<float> importance;

    explicit Row(int count) {
        for (int i = 0; i < count; ++i) {
            bundle.push_back(0);
            for (const double p : {0.9 * i - 0.45 * count, 0.1 * i, 1.3 * i}) position.push_back(p);
            for (const double q : {0.8, 0.0, 0.6, 0.0}) quaternion.push_back(q);
            scale.push_back(1 + 0.1 * (i % 5));
            importance.push_back(1);
        }
    }
    InstanceTable table() const {
        return {.bundle = {bundle.data(), bundle.size()},
                .position = {position.data(), position.size()},
                .quaternion = {quaternion.data(), quaternion.size()},
                .scale = {scale.data(), scale.size()},
                .importance = {importance.data(), importance.size()}};
    }
};

static void select_cuts(const HostTable& table, const Row& row) {
    std::vector<int32_t> pairs;
    std::vector<float> weights;
    for (int view = 0; view < 64; ++view) {
        SelectRule rule{};
        rule.tolerance_px2 = 0.25f * static_cast<float>(view % 16);
        if (view % 3 == 1) rule.budget = 20000 + 3000 * static_cast<uint64_t>(view);
        if (view % 2 == 1) rule.fade = {1.5f, 1 / 1.5f};
        const float x = 0.2f * static_cast<float>(view) - 5;
        SelectOutput cut;
        cpu::select({.bundles = {&table.table(), 1},
                     .instances = row.table(),
                     .eyes = camera_at(x, 4 + 0.3f * static_cast<float>(view), 320, 240),
                     .rule = rule},
                    cut);
        pairs.push_back(static_cast<int32_t>(cut.num_gaussians));
        pairs.insert(pairs.end(), cut.instance.begin(), cut.instance.end());
        pairs.insert(pairs.end(), cut.cluster.begin(), cut.cluster.end());
        weights.push_back(cut.tolerance_px2);
        weights.insert(weights.end(), cut.weight.begin(), cut.weight.end());
    }
    std::printf("%zu decisions\n", pairs.size());
    print_hash("cuts", pairs);
    print_hash("weights", weights);
}

static void draw(const HostTable& table, Cloud& cloud, const Row& row) {
    constexpr int kWidth = 96, kHeight = 64;
    const Model<float> model(cloud.rows());
    const SceneModel drawn{
        .planes = &model.planes(), .appearance = table.appearance(), .palette = {}};
    const HostScene scene{
        .tables = {&table.table(), 1}, .models = {&drawn, 1}, .instances = row.table()};
    std::vector<float> color(3 * kWidth * kHeight), alpha(kWidth * kHeight);
    const Picture<float> picture{.window = {0, 0, kWidth, kHeight},
                                 .background = {0.1f, 0.1f, 0.15f},
                                 .color = color.data(),
                                 .alpha = alpha.data(),
                                 .depth = nullptr};
    SelectRule rule{};
    rule.tolerance_px2 = 1.0f;
    const FrameRequest request{.eyes = camera_at(0, 6, kWidth, kHeight), .rule = rule, .shade = {}};
    const SceneFrameCounts counts = cpu::draw_scene(scene, request, rule, {&picture, 1});
    double sum = 0;
    for (const float value : color) sum += value;
    std::printf("drawn %lld, mean colour %.4f\n", static_cast<long long>(counts.gaussians),
                sum / static_cast<double>(color.size()));
}

// Writes a file and reads it, whole and by a second descriptor in pieces.
static void use_files(Cloud& cloud, const char* path) {
    write_ply(path, cloud.columns<const float>(), PlyEncoding::binary_little_endian, Cloud::kNumSh);
    const PlyFile ply = open_ply(path);
    Cloud read(ply.num_gaussians());
    read_ply(ply, 0, ply.begin(), read.columns());
    print_hash("file means", read.means);
    print_hash("file opacities", read.opacities);
    std::vector<char> head(100), rest(1000);
    FilePiece pieces[2] = {{head.data(), head.size()}, {rest.data(), rest.size()}};
    const size_t count = ply.file.read_at(4, {pieces, 2});
    std::printf("read %zu bytes, %zu at the end, folder %d\n", count,
                ply.file.read_at(ply.file_bytes - 10, head.data(), 100),
                ply.file.is_folder() ? 1 : 0);
    print_hash("pieces", rest);
    try {
        File::open("no such file");
        std::printf("opened a missing file\n");
    } catch (const std::system_error& error) {
        std::printf("missing file: error %d\n", error.code().value());
    }
}

static void run_threads() {
    std::vector<int> counts(10000);
    bool is_nested_alone = true;
    parallel_for(counts.size(), 7, [&](size_t i) {
        if (!is_in_parallel() && most_threads() > 1) is_nested_alone = false;
        if (thread_index() < 0 || thread_index() >= most_threads()) is_nested_alone = false;
        if (i % 1000 == 0)
            parallel_for(10, 1, [&](size_t) {
                if (thread_index() != 0) is_nested_alone = false;
            });
        ++counts[i];
    });
    std::string problem = "none";
    try {
        parallel_for(counts.size(), 7, [&](size_t i) {
            if (i == 4001 || i == 9001) throw std::runtime_error(std::to_string(i));
        });
    } catch (const std::runtime_error& error) {
        problem = error.what();
    }
    int sum = 0;
    for (const int count : counts) sum += count;
    std::printf("threads %s, sum %d, error %s\n", is_nested_alone ? "sound" : "wrong", sum,
                problem.c_str());
}

int main(int num_arguments, char** arguments) {
    Cloud cloud(40000);
    run_threads();
    split(cloud);
    code_page(cloud);
    const Tree tree;
    const HostTable table(tree.table(), {{tree.filter.data(), tree.filter.size()},
                                         {tree.antialiased.data(), tree.antialiased.size()}});
    const Row row(40);
    select_cuts(table, row);
    draw(table, cloud, row);
    use_files(cloud, num_arguments > 1 ? arguments[1] : "portable_core.ply");
    return 0;
}
