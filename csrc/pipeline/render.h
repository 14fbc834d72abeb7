#pragma once

#include <vector>

#include "rasterize/rasterize.h"

namespace v3dg {

// What one picture needs in between; reused from picture to picture.
template <class T>
struct Workspace {
    Buffer<Record<T>> records;
    Buffer<uint32_t> source;
    Buffer<uint64_t> chunk_first;
    Buffer<uint32_t> chunk_count;
    Buffer<uint64_t> chunk_in_frustum;
    TileLists lists;
    size_t num_chunks = 0;
};

struct RenderCounts {
    uint64_t in_frustum;  // gaussians whose extent meets the image
    uint64_t records;     // of them, those that reach a pixel centre
    uint64_t entries;     // (record, tile) pairs
    double project_seconds, bin_seconds, rasterize_seconds;
};

// Draws everything in `draws`: project, bin, sort, blend. Equal depths are blended in the order of the draws.
// With `keep_source` the workspace can go to render_backward. Throws std::length_error past 2^32 gaussians.
template <class T>
RenderCounts render(const std::vector<Draw<T>>& draws, const Pinhole<T>& camera, const Picture<T>& picture,
                    bool keep_source, Workspace<T>& workspace);

// Gradients of the gaussians of a single draw from those of the picture that `workspace` was left by. Adds to
// nothing: `out` is overwritten for gaussians with a record and left alone for others.
template <class T>
void render_backward(const Draw<T>& draw, const Pinhole<T>& camera, const Picture<T>& picture,
                     const PictureGradient<T>& d_picture, const Workspace<T>& workspace,
                     const GaussianGradients<T>& out, T d_background[3]);

}  // namespace v3dg
