#pragma once

// Converts the clusters of a cut on the host to draws: runs of adjacent gaussians with
// the same appearance.

#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include "draw/scene_frame.h"
#include "select/select.h"

namespace v3dg {

// Returns the pairs of a selection. The result points into the selection.
inline GivenCut pairs_of(const SelectOutput& cut) {
    return {.instance = {cut.instance.data(), cut.instance.size()},
            .cluster = {cut.cluster.data(), cut.cluster.size()},
            .weight = {cut.weight.data(), cut.weight.size()}};
}

// Converts the clusters of a cut to draws. Clusters of one instance are joined into a
// single draw if their rows are adjacent, and their appearance and weights are equal.
// `tint` is null, or has SH coefficients of degree 0 that replace the gaussians'
// colours, [S][3] for S pairs.
class CutDraws {
  public:
    CutDraws(const HostScene& scene, const Camera& camera, const GivenCut& given,
             const float* tint = nullptr)
        : scene_(scene), camera_(camera), fades_(given.weight.size > 0) {
        for (size_t s = 0; s < given.instance.size; ++s)
            add(given.instance[s], given.cluster[s], given.weight_of(s),
                tint ? tint + 3 * s : nullptr);
    }

    const std::vector<Draw<float>>& draws() const { return draws_; }
    // Returns the id of each draw's instance.
    Span<const int32_t> instances() const {
        return {instance_of_draw_.data(), instance_of_draw_.size()};
    }
    int64_t num_gaussians() const { return static_cast<int64_t>(num_gaussians_); }
    // Returns the index of the pair that a gaussian belongs to. `gaussian` is its index
    // in the concatenation of all draws.
    size_t pair_of(uint64_t gaussian) const {
        return std::upper_bound(end_of_pair_.begin(), end_of_pair_.end(), gaussian) -
               end_of_pair_.begin();
    }

  private:
    void add(int32_t i, int32_t c, float weight, const float* tint) {
        if (i < 0 || static_cast<size_t>(i) >= scene_.instances.bundle.size)
            throw std::out_of_range("instance_ids: expected ids of the scene's instances, got " +
                                    std::to_string(i));
        const int32_t bundle = scene_.instances.bundle[i];
        const SceneModel& model = scene_.models[bundle];
        const ClusterTable& table = scene_.tables[bundle];
        if (c < 0 || static_cast<size_t>(c) >= table.num_clusters())
            throw std::out_of_range("cluster_ids: expected ids of the bundle's clusters, got " +
                                    std::to_string(c));
        const uint64_t first = table.first_row(c), count = table.num_gaussians(c);
        end_of_pair_.push_back(num_gaussians_);
        if (i != last_instance_) {
            const Pose pose = scene_.instances.pose(i);
            if (!scene_.instances.is_drawn(i)) return;
            view_ = model_view_from_instance(axes_of_instance(camera_, pose), pose);
        }
        end_of_pair_.back() = num_gaussians_ += count;
        if (tint == nullptr && model.cluster_sh != nullptr) tint = model.cluster_sh + 3 * size_t(c);
        const Palette palette = tint == nullptr ? model.palette : Palette{tint, nullptr, 1};
        const Appearance<float> appearance =
            fades_ ? model.appearance.faded(table, c) : model.appearance[c];
        const Span<const InstanceFactors>& factors = scene_.instances.factors;
        const Draw<float> next{.model = model.planes,
                               .first = first,
                               .count = count,
                               .view = view_,
                               .appearance = appearance,
                               .palette = palette,
                               .codes = model.codes,
                               .weight = factors.empty() ? weight : weight * factors[i].opacity,
                               .color_factors = factors.empty() ? nullptr : factors[i].color};
        if (i == last_instance_ && joins(draws_.back(), next))
            draws_.back().count += count;
        else
            add_draw(next, i);
        last_instance_ = i;
    }

    void add_draw(const Draw<float>& draw, int32_t i) {
        draws_.push_back(draw);
        instance_of_draw_.push_back(scene_.instance_ids.empty() ? i : scene_.instance_ids[i]);
    }

    // Returns whether two draws of one instance can be joined: b must begin where a
    // ends, and both must have the same appearance.
    static bool joins(const Draw<float>& a, const Draw<float>& b) {
        return a.first + a.count == b.first && a.appearance == b.appearance &&
               a.weight == b.weight && a.palette.sh == b.palette.sh;
    }

    const HostScene& scene_;
    const Camera& camera_;
    const bool fades_;
    std::vector<Draw<float>> draws_;
    std::vector<int32_t> instance_of_draw_;
    // [S] end of each pair's gaussians in the concatenation of all draws.
    std::vector<uint64_t> end_of_pair_;
    uint64_t num_gaussians_ = 0;
    int32_t last_instance_ = -1;
    ModelView<float> view_{};
};

}  // namespace v3dg
