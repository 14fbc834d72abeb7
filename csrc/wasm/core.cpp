// The core as a WebAssembly module for web pages: selection with budgets and fades,
// decoding of pages, and hashes. It has no threads and reads no files. The JavaScript
// code parses the header of a bundle, fetches bytes, and passes the tables.
//
// All pointers are addresses in the module's memory, allocated with v3dg_allocate().
// The module keeps pointers to tables, so tables must stay in memory as long as the
// bundle. The caller must check sizes and indices, because the functions of this module
// do not. core.js in v3dg/export/web is the interface for JavaScript.

#include <cstdint>
#include <memory>
#include <vector>

#include "base/host_memory.h"
#include "camera/camera_arrays.h"
#include "cluster/check_tables.h"
#include "io/blake2b.h"
#include "quantize/quantize.h"
#include "residency/cluster_table.h"
#include "select/select.h"

// For WebAssembly, the C++ library is built without exceptions. An error, which usually
// is out of memory, ends the call with a trap; the module must then be loaded again.
extern "C" {
void* __cxa_allocate_exception(size_t) noexcept { __builtin_trap(); }
[[noreturn]] void __cxa_throw(void*, void*, void (*)(void*)) { __builtin_trap(); }
}

#define V3DG_EXPORT(name) extern "C" __attribute__((export_name(#name), used))

using namespace v3dg;

namespace {

// The tables of a bundle, in the order that core.js uses.
struct BundleArrays {
    uint32_t num_groups, num_clusters;
    const float *ball, *weight;
    const int32_t *level, *own_group, *parent_group;
    const float* box;
    const int64_t* offset;
    const float* filter_px2;
    const uint8_t* antialiased;
    // [G + 1] kAbsentPage for pages that are absent, and any row for others; null if
    // all pages are resident
    const int64_t* shift;
    const int32_t* begins;  // [G + 1] as in PageTable::begins; null if all pages have
                            // faded in
    uint32_t* needs;        // [G + 1] as in SelectInput::needs; null if needs are not
                            // requested
};

struct WebBundle {
    explicit WebBundle(const BundleArrays& in)
        : table(table_of(in),
                {{in.filter_px2, in.num_clusters}, {in.antialiased, in.num_clusters}}),
          needs{in.needs, in.needs == nullptr ? 0 : in.num_groups + size_t(1)} {}

    static ClusterTable table_of(const BundleArrays& in) {
        const size_t groups = in.num_groups, clusters = in.num_clusters;
        ClusterTable table{};
        table.ball = {reinterpret_cast<const Ball*>(in.ball), groups};
        table.weight = {in.weight, groups};
        table.level = {in.level, groups};
        table.own_group = {in.own_group, clusters};
        table.parent_group = {in.parent_group, clusters};
        table.box = {reinterpret_cast<const Box*>(in.box), clusters};
        table.offset = {in.offset, clusters + 1};
        if (in.shift != nullptr) table.pages.shift = {in.shift, groups + 1};
        if (in.begins != nullptr) table.pages.begins = {in.begins, groups + 1};
        return table;
    }

    HostTable table;
    Span<uint32_t> needs;
};

// The tables of a file, in the order that core.js uses. They may have any contents.
struct FileArrays {
    uint32_t num_groups, num_clusters;
    const int64_t* offset;
    const int32_t *level, *own_group, *parent_group;
    const float *box, *filter_px2;
    const uint8_t* antialiased;
    const float *ball, *weight;
    const int32_t *parent, *group_level;
    const float* error;
};

// The instances of a scene, in the order that core.js uses.
struct InstanceArrays {
    uint32_t count;
    const int32_t* bundle;
    const double *position, *quaternion, *scale;
    const float* importance;
    const float* factors;  // [I * 4] null if all factors are 1
};

// A pinhole camera and the rule of a cut, in the order that core.js uses.
struct ViewValues {
    double viewmat[16], k[9];
    double near_depth;
    double tolerance_px2;
    double budget;  // negative if there is no budget
    double fade;
    int32_t width, height, min_level, culls, is_paper, in_steps, frames_at_rest, frame;
};

SelectRule rule_of(const ViewValues& view) {
    SelectRule rule{};
    rule.tolerance_px2 = static_cast<float>(view.tolerance_px2);
    rule.footprint = view.is_paper != 0 ? Footprint::paper : Footprint::solid_angle;
    rule.culls = view.culls != 0;
    rule.min_level = view.min_level;
    rule.budget = view.budget < 0 ? kNoBudget : static_cast<uint64_t>(view.budget);
    rule.pace = view.in_steps != 0 ? BudgetPace::in_steps : BudgetPace::at_once;
    rule.frames_at_rest = view.frames_at_rest;
    rule.fade = {static_cast<float>(view.fade), 1.0f / static_cast<float>(view.fade)};
    rule.frame = view.frame;
    return rule;
}

// A scene and its last cut.
struct WebScene {
    std::vector<const WebBundle*> bundles;
    InstanceTable instances = {};
    uint32_t last_bin = kNoBin;
    SelectOutput cut;

    void select(const ViewValues& view) {
        std::vector<ClusterTable> tables;
        std::vector<Span<uint32_t>> needs;
        bool has_needs = true;
        for (const WebBundle* bundle : bundles) {
            tables.push_back(bundle->table.table());
            needs.push_back(bundle->needs);
            has_needs = has_needs && !bundle->needs.empty();
        }
        cut.instance.clear();
        cut.cluster.clear();
        cut.weight.clear();
        cut.fits_budget = true;
        SelectInput input{
            .bundles = {tables.data(), tables.size()},
            .instances = instances,
            .eyes = camera_of(view.viewmat, view.k, view.width, view.height, view.near_depth),
            .rule = rule_of(view),
            .last_bin = view.in_steps != 0 ? &last_bin : nullptr};
        if (has_needs) input.needs = {needs.data(), needs.size()};
        cpu::select(input, cut);
    }
};

// The result of a selection, in the order that core.js uses.
struct CutValues {
    double num_gaussians;
    float tolerance_px2;
    uint32_t fits_budget, count;
    const int32_t *instance, *cluster;
    const float* weight;  // null without a fade
};

}  // namespace

// Allocates memory that is aligned to 64 bytes. Returns null if there is too little.
V3DG_EXPORT(v3dg_allocate) void* v3dg_allocate(uint32_t bytes) { return allocate_pages(bytes); }
V3DG_EXPORT(v3dg_free) void v3dg_free(void* memory) { free_pages(memory); }

// Returns if the tables are valid, and otherwise ends with a trap. The number of
// gaussians is taken from the tables.
V3DG_EXPORT(v3dg_check_tables) void v3dg_check_tables(const FileArrays* in) {
    const size_t groups = in->num_groups, clusters = in->num_clusters;
    check_tables({.offset = {in->offset, clusters + 1},
                  .level = {in->level, clusters},
                  .own_group = {in->own_group, clusters},
                  .parent_group = {in->parent_group, clusters},
                  .box = {reinterpret_cast<const Box*>(in->box), clusters},
                  .filter_px2 = {in->filter_px2, clusters},
                  .antialiased = {in->antialiased, clusters},
                  .ball = {reinterpret_cast<const Ball*>(in->ball), groups},
                  .weight = {in->weight, groups},
                  .parent = {in->parent, groups},
                  .group_level = {in->group_level, groups},
                  .error = {in->error, 2 * groups}},
                 in->offset[clusters]);
}

V3DG_EXPORT(v3dg_make_bundle) WebBundle* v3dg_make_bundle(const BundleArrays* arrays) {
    return new WebBundle(*arrays);
}
V3DG_EXPORT(v3dg_free_bundle) void v3dg_free_bundle(WebBundle* bundle) { delete bundle; }

V3DG_EXPORT(v3dg_make_scene)
WebScene* v3dg_make_scene(const WebBundle* const* bundles, uint32_t count) {
    auto scene = std::make_unique<WebScene>();
    scene->bundles.assign(bundles, bundles + count);
    return scene.release();
}
V3DG_EXPORT(v3dg_free_scene) void v3dg_free_scene(WebScene* scene) { delete scene; }

// Sets the instances of a scene. The module keeps pointers to the arrays. Their values
// may be changed until the next call.
V3DG_EXPORT(v3dg_set_instances)
void v3dg_set_instances(WebScene* scene, const InstanceArrays* in) {
    const size_t count = in->count;
    scene->instances = {.bundle = {in->bundle, count},
                        .position = {in->position, 3 * count},
                        .quaternion = {in->quaternion, 4 * count},
                        .scale = {in->scale, count},
                        .importance = {in->importance, count}};
    if (in->factors != nullptr)
        scene->instances.factors = {reinterpret_cast<const InstanceFactors*>(in->factors), count};
}

// Selects the cut of a view. `out` receives pointers to memory of the scene, which is
// valid until the scene's next selection.
V3DG_EXPORT(v3dg_select)
void v3dg_select(WebScene* scene, const ViewValues* view, CutValues* out) {
    scene->select(*view);
    const SelectOutput& cut = scene->cut;
    *out = {.num_gaussians = static_cast<double>(cut.num_gaussians),
            .tolerance_px2 = cut.tolerance_px2,
            .fits_budget = cut.fits_budget,
            .count = static_cast<uint32_t>(cut.instance.size()),
            .instance = cut.instance.data(),
            .cluster = cut.cluster.data(),
            .weight = cut.weight.empty() ? nullptr : cut.weight.data()};
}

// Returns the number of clusters of a coded page. If ranges are invalid, returns the
// index of the first such cluster instead. `offset` is as for v3dg_decode_page().
V3DG_EXPORT(v3dg_check_page)
uint32_t v3dg_check_page(const int64_t* offset, uint32_t num_clusters, const uint32_t* words,
                         int32_t sh_degree) {
    const PageCodes<const uint32_t> page{{offset, num_clusters + size_t(1)}, words, sh_degree};
    for (uint32_t c = 0; c < num_clusters; ++c) {
        const uint32_t* ranges = page.ranges(c);
        if (!are_valid(*reinterpret_cast<const ClusterCode*>(ranges),
                       reinterpret_cast<const uint16_t*>(ranges + sizeof(ClusterCode) / 4),
                       sh_degree))
            return c;
    }
    return num_clusters;
}

// Decodes the gaussians of a coded page, and returns the number of its clusters.
// `offset` has the first row of each cluster, then the end. If ranges are invalid,
// decodes nothing, and returns the index of the first such cluster.
V3DG_EXPORT(v3dg_decode_page)
uint32_t v3dg_decode_page(const int64_t* offset, uint32_t num_clusters, const uint32_t* words,
                          int32_t sh_degree, float* means, float* quats, float* scales,
                          float* opacities, float* sh) {
    const uint32_t num_valid = v3dg_check_page(offset, num_clusters, words, sh_degree);
    if (num_valid < num_clusters) return num_valid;
    const PageCodes<const uint32_t> page{{offset, num_clusters + size_t(1)}, words, sh_degree};
    cpu::decode_page(page, {.means = means,
                            .quats = quats,
                            .scales = scales,
                            .opacities = opacities,
                            .sh = sh,
                            .size = page.end_row() - page.first_row(),
                            .sh_degree = sh_degree});
    return num_clusters;
}

// Writes the hash of a page, 16 bytes.
V3DG_EXPORT(v3dg_hash) void v3dg_hash(const uint8_t* bytes, uint32_t size, uint8_t* hash) {
    const Span<const uint8_t> message{bytes, size};
    PageHash digest;
    blake2b({&message, 1}, &digest);
    for (size_t i = 0; i < digest.size(); ++i) hash[i] = digest[i];
}
