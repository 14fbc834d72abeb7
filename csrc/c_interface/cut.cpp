// Selects cuts, lists the pages that are missing, and gathers the gaussians of cuts.
// Pages are read and decoded in parallel, and their gaussians are transformed together.

#include "c_interface/cut.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>

#include "base/buffer.h"
#include "base/parallel_for.h"
#include "c_interface/fault.h"
#include "c_interface/rows.h"
#include "gather/gather.h"
#include "select/page_need.h"
#include "select/select.h"

namespace v3dg {

namespace {

constexpr double kMostFade = 1000;
constexpr uint64_t kMostBudget = std::numeric_limits<int64_t>::max();

// A cut that owns the memory of its arrays.
struct OwnedCut : v3dg_cut {
    Buffer<v3dg_pair> pairs_memory;
    std::vector<v3dg_missing_page> missing_memory;
};

SelectRule core_rule(const v3dg_rule& rule) {
    const double tolerance = rule.tolerance_px2;
    check_argument(tolerance >= 0, "tolerance",
                   "a number of px² of at least 0, got " + text_of(tolerance));
    check_argument(
        rule.budget == V3DG_NO_BUDGET || rule.budget <= kMostBudget, "budget",
        "at most " + std::to_string(kMostBudget) + ", got " + std::to_string(rule.budget));
    check_argument(rule.fade >= 1 && rule.fade <= kMostFade, "fade",
                   "a factor from 1 to 1000, got " + text_of(rule.fade));
    check_argument(rule.min_level >= 0, "min_level",
                   "the index of a level, at least 0, got " + std::to_string(rule.min_level));
    constexpr double kMostFloat = std::numeric_limits<float>::max();
    const bool is_finite = std::isfinite(tolerance);
    SelectRule out{};
    out.tolerance_px2 = static_cast<float>(is_finite ? std::min(tolerance, kMostFloat) : tolerance);
    out.culls = rule.culls != 0;
    out.min_level = rule.min_level;
    out.budget = rule.budget == V3DG_NO_BUDGET ? kNoBudget : rule.budget;
    const auto factor = static_cast<float>(rule.fade);
    out.fade = {factor, 1.0f / factor};
    return out;
}

// The tables of a scene's bundles with their resident pages, and the pages that the cut
// needs.
struct SceneTables {
    std::vector<ClusterTable> tables;
    std::vector<std::vector<uint32_t>> needs;
    std::vector<Span<uint32_t>> needs_spans;

    explicit SceneTables(const v3dg_scene& scene) {
        for (size_t b = 0; b < scene.content.bundles.size(); ++b) {
            const std::vector<int64_t>& shift = scene.page_shift[b];
            tables.push_back(scene.content.bundles[b]->table());
            tables.back().pages.shift = {shift.data(), shift.size()};
            needs.emplace_back(shift.size(), 0);
        }
        for (std::vector<uint32_t>& need : needs) needs_spans.push_back({need.data(), need.size()});
    }
};

v3dg_pair pair_of(const v3dg_scene& scene, const SelectOutput& selected, size_t s, bool fades) {
    const auto instance = static_cast<size_t>(selected.instance[s]);
    const auto cluster = static_cast<size_t>(selected.cluster[s]);
    const OpenBundle& bundle = *scene.content.bundles[scene.content.instances[instance].bundle];
    const ClusterTable& table = bundle.table();
    const size_t page = table.page_of(cluster);
    const Appearance<float> appearance =
        fades ? bundle.appearance().faded(table, cluster) : bundle.appearance()[cluster];
    v3dg_pair pair{};
    pair.instance = selected.instance[s];
    pair.cluster = selected.cluster[s];
    pair.page = static_cast<uint32_t>(page);
    pair.first_in_page =
        static_cast<uint32_t>(table.offset[cluster] - bundle.pages().first_row(page));
    pair.num_gaussians = static_cast<uint32_t>(table.num_gaussians(cluster));
    pair.weight = fades ? selected.weight[s] : 1.0f;
    pair.filter_px2 = appearance.filter_px2;
    pair.is_antialiased = appearance.antialiased ? 1 : 0;
    return pair;
}

// Adds the absent pages of a bundle that a cut needs. Also adds the absent pages above
// them, which are at least as urgent.
void add_missing(const OpenBundle& bundle, uint32_t number, const std::vector<int64_t>& shift,
                 std::vector<uint32_t>& needs, std::vector<v3dg_missing_page>& missing) {
    // Groups come before their parents in the table.
    for (size_t page = 0; page + 1 < needs.size(); ++page) {
        float priority;
        std::memcpy(&priority, &needs[page], sizeof priority);
        if (shift[page] != kAbsentPage || !(priority >= kLeastPriority)) continue;
        missing.push_back({number, static_cast<uint32_t>(page), priority});
        const int32_t parent = bundle.parent_of_group(page);
        // Bits of positive floats have the same order as the floats.
        if (parent >= 0) needs[parent] = std::max(needs[parent], needs[page]);
    }
}

std::vector<v3dg_missing_page> missing_pages(const v3dg_scene& scene, SceneTables& tables) {
    std::vector<v3dg_missing_page> missing;
    for (size_t b = 0; b < tables.needs.size(); ++b)
        add_missing(*scene.content.bundles[b], static_cast<uint32_t>(b), scene.page_shift[b],
                    tables.needs[b], missing);
    std::sort(missing.begin(), missing.end(),
              [](const v3dg_missing_page& a, const v3dg_missing_page& b) {
                  if (a.priority != b.priority) return a.priority > b.priority;
                  return a.bundle != b.bundle ? a.bundle < b.bundle : a.page > b.page;
              });
    return missing;
}

// The gaussians of the pages of one bundle that a cut uses.
struct LoadedPages {
    std::vector<uint32_t> pages;     // ascending
    std::vector<int64_t> first_row;  // first row of each page
    Buffer<unsigned char> memory;
    v3dg_gaussians rows{};

    void load(const OpenBundle& bundle) {
        std::sort(pages.begin(), pages.end());
        pages.erase(std::unique(pages.begin(), pages.end()), pages.end());
        const PageSource& source = bundle.pages();
        size_t count = 0;
        for (const uint32_t page : pages) {
            first_row.push_back(static_cast<int64_t>(count));
            count += source.num_rows(page);
        }
        const GaussianRows<const float> all = allocate(count, source.sh_degree());
        rows = {.means = const_cast<float*>(all.means),
                .quaternions = const_cast<float*>(all.quats),
                .scales = const_cast<float*>(all.scales),
                .opacities = const_cast<float*>(all.opacities),
                .sh = const_cast<float*>(all.sh),
                .capacity = count,
                .sh_degree = source.sh_degree()};
        const size_t num_batches = (pages.size() + kBatch - 1) / kBatch;
        parallel_for(num_batches, 1, [&](size_t k) {
            read_batch(source, k * kBatch, std::min(pages.size(), (k + 1) * kBatch));
        });
    }

    GaussianRows<const float> core_rows() const {
        return {.means = rows.means,
                .quats = rows.quaternions,
                .scales = rows.scales,
                .opacities = rows.opacities,
                .sh = rows.sh,
                .size = rows.capacity,
                .sh_degree = rows.sh_degree};
    }
    int64_t row_of(const v3dg_pair& pair) const {
        const auto found = std::lower_bound(pages.begin(), pages.end(), pair.page);
        return first_row[found - pages.begin()] + pair.first_in_page;
    }

  private:
    static constexpr size_t kBatch = 16;
    static_assert(kBatch <= kMostPagesTogether);

    GaussianRows<const float> allocate(size_t count, int sh_degree) {
        const size_t num_floats = 11 + 3 * static_cast<size_t>(num_sh_bases(sh_degree));
        return rows_of_page(memory.reserve(sizeof(float) * num_floats * count + 1), count,
                            sh_degree);
    }

    void read_batch(const PageSource& source, size_t first, size_t end) const {
        std::vector<PageReading> readings;
        size_t num_bytes = 0;
        for (size_t k = first; k < end; ++k) num_bytes += source.num_bytes(pages[k]);
        Buffer<unsigned char> bytes(num_bytes + 1);
        size_t place = 0;
        for (size_t k = first; k < end; ++k) {
            readings.push_back({pages[k], bytes.data() + place, {}});
            place += source.num_bytes(pages[k]);
        }
        source.read_pages({readings.data(), readings.size()});
        std::vector<float> decoded;
        for (size_t k = first; k < end; ++k) {
            const PageReading& reading = readings[k - first];
            if (reading.error) throw PageError(*reading.error);
            copy_rows(source.rows(reading.page, reading.bytes, decoded), rows,
                      static_cast<size_t>(first_row[k]));
        }
    }
};

// The instances of a cut, each of them once, in columns.
struct CutInstances {
    std::vector<int32_t> ids, bundle;
    std::vector<double> position, quaternion, scale;
    std::vector<InstanceFactors> factors;

    CutInstances(const v3dg_scene& scene, const v3dg_cut& cut, const double origin[3]) {
        for (uint64_t s = 0; s < cut.num_pairs; ++s)
            if (s == 0 || cut.pairs[s].instance != ids.back()) ids.push_back(cut.pairs[s].instance);
        const InstanceTable table = scene.columns.table();
        for (const int32_t i : ids) {
            bundle.push_back(table.bundle[i]);
            for (int k = 0; k < 3; ++k)
                position.push_back(table.position[3 * size_t(i) + k] - (origin ? origin[k] : 0.0));
            for (int k = 0; k < 4; ++k) quaternion.push_back(table.quaternion[4 * size_t(i) + k]);
            scale.push_back(table.scale[i]);
            if (!table.factors.empty()) factors.push_back(table.factors[i]);
        }
    }
};

// Returns an array of the caller, or temporary memory if the caller passed none.
float* array_of(float* wanted, size_t size, Buffer<float>& own) {
    return wanted == nullptr ? own.reserve(size + 1) : wanted;
}

template <class T>
Span<const T> span_of(const std::vector<T>& values) {
    return {values.data(), values.size()};
}

}  // namespace

v3dg_cut* select_cut(const v3dg_scene& scene, const Eyes& eyes, const v3dg_rule& rule) {
    const SelectRule checked = core_rule(rule);
    SceneTables tables(scene);
    SelectInput input{.bundles = span_of(tables.tables),
                      .instances = scene.columns.table(),
                      .eyes = eyes,
                      .rule = checked,
                      .needs = {tables.needs_spans.data(), tables.needs_spans.size()}};
    SelectOutput selected;
    cpu::select(input, selected);
    if (!selected.fits_budget)
        throw Fault(V3DG_ERROR_BUDGET,
                    "budget: expected at least " + std::to_string(selected.num_gaussians) +
                        ", the number of gaussians in the coarsest cut of this view, got " +
                        std::to_string(rule.budget));
    auto cut = std::make_unique<OwnedCut>();
    const bool fades = checked.fade.is_on();
    const size_t num_pairs = selected.instance.size();
    v3dg_pair* pairs = cut->pairs_memory.reserve(num_pairs + 1);
    parallel_for(num_pairs, 4096, [&](size_t s) { pairs[s] = pair_of(scene, selected, s, fades); });
    cut->missing_memory = missing_pages(scene, tables);
    cut->pairs = pairs;
    cut->num_pairs = num_pairs;
    cut->num_gaussians = static_cast<uint64_t>(selected.num_gaussians);
    cut->missing = cut->missing_memory.data();
    cut->num_missing = cut->missing_memory.size();
    cut->revision = scene.revision;
    cut->tolerance_px2 = selected.tolerance_px2;
    return cut.release();
}

void free_cut(v3dg_cut* cut) { delete static_cast<OwnedCut*>(cut); }

void read_cut(const v3dg_scene& scene, const v3dg_cut& cut, const double origin[3],
              const v3dg_gaussians& out) {
    check_argument(cut.revision == scene.revision, "cut",
                   "a cut of the scene's current instances, got another; select again");
    check_room(out, cut.num_gaussians);
    const std::vector<SharedBundle>& bundles = scene.content.bundles;
    std::vector<LoadedPages> pages(bundles.size());
    const InstanceTable table = scene.columns.table();
    for (uint64_t s = 0; s < cut.num_pairs; ++s)
        pages[table.bundle[cut.pairs[s].instance]].pages.push_back(cut.pairs[s].page);
    std::vector<GaussianRows<const float>> rows;
    for (size_t b = 0; b < bundles.size(); ++b) {
        pages[b].load(*bundles[b]);
        rows.push_back(pages[b].core_rows());
    }
    const CutInstances instances(scene, cut, origin);
    std::vector<int32_t> instance;
    std::vector<int64_t> first_row;
    std::vector<int64_t> offset{0};
    std::vector<float> weight;
    for (uint64_t s = 0; s < cut.num_pairs; ++s) {
        const v3dg_pair& pair = cut.pairs[s];
        const bool is_next = s > 0 && pair.instance != cut.pairs[s - 1].instance;
        instance.push_back(s == 0 ? 0 : instance.back() + (is_next ? 1 : 0));
        first_row.push_back(pages[table.bundle[pair.instance]].row_of(pair));
        offset.push_back(offset.back() + pair.num_gaussians);
        weight.push_back(pair.weight);
    }
    const auto count = static_cast<size_t>(cut.num_gaussians);
    const auto num_sh = static_cast<size_t>(3 * num_sh_bases(out.sh_degree));
    Buffer<float> unwanted[5];
    cpu::gather({.bundles = span_of(rows),
                 .bundle = span_of(instances.bundle),
                 .position = span_of(instances.position),
                 .quaternion = span_of(instances.quaternion),
                 .scale = span_of(instances.scale),
                 .factors = span_of(instances.factors),
                 .instance = span_of(instance),
                 .first_row = span_of(first_row),
                 .offset = span_of(offset),
                 .weight = span_of(weight)},
                {.means = array_of(out.means, 3 * count, unwanted[0]),
                 .quats = array_of(out.quaternions, 4 * count, unwanted[1]),
                 .scales = array_of(out.scales, 3 * count, unwanted[2]),
                 .opacities = array_of(out.opacities, count, unwanted[3]),
                 .sh = array_of(out.sh, num_sh * count, unwanted[4]),
                 .size = count,
                 .sh_degree = out.sh_degree});
}

}  // namespace v3dg
