#pragma once

#include <atomic>
#include <vector>

#include "base/buffer.h"
#include "frame/draw_list.h"
#include "frame/image.h"
#include "frame/record.h"
#include "tile_bin/tile_bin.h"

namespace v3dg {

// What one picture needs in between; reused from picture to picture.
template <class T>
struct Workspace {
    // Records of a chunk lie side by side in the order of the draws, chunks in any order and with
    // gaps.
    Buffer<Record<T>> records;
    Buffer<uint32_t> source;
    Buffer<uint64_t> chunk_first;
    Buffer<uint32_t> chunk_count;
    TileLists lists;
    size_t num_chunks = 0;
    uint64_t room = 0;       // of the records, gaps included
    uint64_t most_room = 0;  // that there was: what of theirs may be in memory
};

struct RenderCounts {
    uint64_t in_frustum;  // gaussians whose extent meets the image
    uint64_t records;     // of them, those that reach a pixel centre
    uint64_t entries;     // records in the lists of the window's tiles
    double project_seconds, bin_seconds, rasterize_seconds;
};

// Draws the picture's window of everything in `draws`: project, bin, sort, blend. Equal depths are
// blended in the order of the draws. What is too much for memory at once is drawn in bands of tile
// rows, with the same result. With `keep_source` it is one band, and the workspace can go to
// render_backward: `source` is then each record's place among the gaussians of all draws. Throws
// std::length_error past about 3e9 gaussians. Once `stop` is true, returns soon and leaves the
// picture and the counts unfinished.
template <class T>
RenderCounts render(const std::vector<Draw<T>>& draws, const Intrinsics<T>& camera,
                    const Picture<T>& picture, bool keep_source, Workspace<T>& workspace,
                    const std::atomic<bool>* stop = nullptr);

// The gaussian that a pixel shows most of.
struct Pick {
    uint64_t gaussian;  // among the gaussians of all draws
    float weight;       // its share of the pixel
    float depth;
};

// Returns whether there is any.
bool pick(const std::vector<Draw<float>>& draws, const Intrinsics<float>& camera, int x, int y,
          Pick& picked);

// Gradients of the gaussians of a single draw from those of the picture that `workspace` was left
// by. Adds to nothing: `out` and `centers` are overwritten for gaussians with a record and left
// alone for others.
template <class T>
void render_backward(const Draw<T>& draw, const Intrinsics<T>& camera, const Picture<T>& picture,
                     const PictureGradient<T>& d_picture, const Workspace<T>& workspace,
                     const GaussianRows<T>& out, const CenterGradients<T>& centers,
                     T d_background[3]);

}  // namespace v3dg
