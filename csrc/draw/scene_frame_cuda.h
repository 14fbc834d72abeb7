#pragma once

// Frames of a scene on a CUDA device, which enqueue the drawing of a request, and the
// models that frames draw.

#include "draw/device_pages.h"
#include "draw/frame_cuda.h"
#include "draw/request.h"
#include "quantize/quantize.h"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

// Returns a FrameImage for a frame with one picture, including its tiles.
FrameImage frame_image(const Intrinsics<float>& camera, int width, int height,
                       const float background[3], const PicturePlanes& planes);

// The packed gaussians of a model that never changes.
class PackedModel {
  public:
    PackedModel(const GaussianRows<const float>& rows, cudaStream_t stream);
    const GaussianRows<const float>& rows() const { return rows_; }
    const PackedPlanes& packed() const { return packed_; }
    size_t bytes() const { return planes_.capacity() * sizeof(float); }

  private:
    GaussianRows<const float> rows_;
    DeviceBuffer<float> planes_;
    PackedPlanes packed_;
};

// The coded gaussians of a model, on the device that is current at construction. All
// records are contiguous, and so are all SH codes, so that the address of a row follows
// from its index.
class CodedModel {
  public:
    // Returns when the codes are on the device.
    CodedModel(const CodedPages& pages, cudaStream_t stream);
    const Codes& codes() const { return codes_; }
    size_t bytes() const {
        return records_.bytes() + sh_.bytes() + ranges_.bytes() + offset_.bytes();
    }

  private:
    DeviceBuffer<uint32_t> records_, sh_;
    DeviceBuffer<unsigned char> ranges_;
    DeviceBuffer<int64_t> offset_;
    Codes codes_;
};

// The gaussians of a bundle. One of the two pointers is set.
struct DeviceModel {
    std::shared_ptr<const PackedModel> packed;
    std::shared_ptr<const CodedModel> coded;
};

// The colours of the clusters of one bundle, on the device.
class DevicePalette {
  public:
    // `sh` is (C, 3), SH coefficients of degree 0 in host memory. The caller may reuse
    // this memory on return.
    DevicePalette(Span<const float> sh, std::shared_ptr<const BundleTables> tables,
                  cudaStream_t stream);
    Palette palette() const;

  private:
    std::shared_ptr<const BundleTables> tables_;
    DeviceBuffer<float> sh_;
};

// Combines the pictures of two eyes into one frame.
EyeImages images_of_eyes(const FrameImage& left, FrameImage right, float min_transmittance);

// Draws a scene whose tables are on the device: selects a cut, then draws the cut.
class SceneFrame {
  public:
    // Sets the gaussians of each bundle of the scene and, unless `palettes` is empty,
    // the colours of the bundles' clusters. The caller may reuse host memory on return.
    void set_models(std::vector<DeviceModel> models,
                    std::vector<std::shared_ptr<const DevicePalette>> palettes,
                    cudaStream_t stream);

    // Enqueues a plain request (FrameRequest::is_plain). `pictures` are the pictures to
    // draw; `place` sets their destinations. With `pages`, it first brings in pages
    // that are ready, then draws the resident part of the pool's bundles. `rule` is the
    // request's rule after the pacing of a budget; it is set to the rule that was used.
    //
    // The scene, the pool and a given cut must exist until the drawing is finished. A
    // given cut is on the device and has one picture. If the frame is drawn again, it
    // uses the pages that are resident at that time.
    std::unique_ptr<Drawing> draw(const SceneTables& scene, DevicePages* pages,
                                  const FrameRequest& request, SelectRule& rule,
                                  const EyeImages& pictures, cudaStream_t stream,
                                  const Frame::Place& place);

    // Returns the device memory in bytes, by part, without the models.
    std::vector<std::pair<const char*, size_t>> bytes() const;

  private:
    std::unique_ptr<Drawing> draw_selected(const SceneTables& scene, const Eyes& eyes,
                                           const SelectRule& rule, const EyeImages& pictures,
                                           cudaStream_t stream, const Frame::Place& place);
    std::unique_ptr<Drawing> draw_resident(const SceneTables& scene, DevicePages& pages,
                                           const Eyes& eyes, SelectRule& rule,
                                           const EyeImages& pictures, cudaStream_t stream,
                                           const Frame::Place& place);
    std::unique_ptr<Drawing> draw_given(const SceneTables& scene, const FrameRequest& request,
                                        const EyeImages& pictures, cudaStream_t stream,
                                        const Frame::Place& place);
    // Returns the batch that draws the models.
    FrameBatch batch(const SceneTables& scene, const EyeImages& pictures, const SelectRule& rule,
                     cudaStream_t stream);

    std::vector<DeviceModel> models_;
    std::vector<std::shared_ptr<const DevicePalette>> palettes_;
    DeviceBuffer<GaussianRows<const float>> rows_;
    DeviceBuffer<PackedPlanes> packed_;
    DeviceBuffer<CodedGaussians> coded_;
    bool has_packed_ = false, has_coded_ = false;
    DeviceBuffer<Placement> placements_;
    DeviceBuffer<FrameImage> images_;
    Cut cut_;
    Frame frame_;
};

// A model, and the camera in front of which it is placed.
struct ModelTables {
    GaussianRows<const float> rows;
    PackedPlanes packed;
    Placement placement;
    FrameImage image;
};

// Draws all gaussians of one model on CUDA.
class ModelFrame {
  public:
    explicit ModelFrame(Frame::Keeps keeps = Frame::Keeps::nothing) : frame_(keeps) {}

    // Enqueues a picture of a model. The rows, and the planes packed from them, must
    // exist until the drawing is finished.
    std::unique_ptr<Drawing> draw(const GaussianRows<const float>& rows,
                                  const ModelView<float>& view, float filter_px2, bool antialiased,
                                  const FrameImage& image, cudaStream_t stream,
                                  const PackedPlanes* packed = nullptr,
                                  float min_transmittance = kStopsBefore,
                                  const Frame::Place& place = {});
    FrameTape tape() const { return frame_.tape(); }

  private:
    DeviceBuffer<ModelTables> tables_;
    Frame frame_;
};

}  // namespace cuda
}  // namespace v3dg
