#pragma once

// Draws frames of a scene on a CUDA device by enqueuing the work of a request. Also has
// the models that frames draw.

#include "draw/clipped.h"
#include "draw/device_pages.h"
#include "draw/frame_cuda.h"
#include "draw/part_limit.h"
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

// The coded gaussians of a model, on the device that is current at construction. The
// codes of all records, and all SH codes, are contiguous, so that the address of a row
// follows from its index.
class CodedModel {
  public:
    // Returns after the codes have been copied to the device.
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

// The gaussians of a bundle. Exactly one of the two pointers is set.
struct DeviceModel {
    std::shared_ptr<const PackedModel> packed;
    std::shared_ptr<const CodedModel> coded;
};

// The colours of the clusters of one bundle, on the device.
class DevicePalette {
  public:
    // `sh` is (C, 3): SH coefficients of degree 0 in host memory. The constructor
    // copies them.
    DevicePalette(Span<const float> sh, std::shared_ptr<const BundleTables> tables,
                  cudaStream_t stream);
    Palette palette() const;

  private:
    std::shared_ptr<const BundleTables> tables_;
    DeviceBuffer<float> sh_;
};

// Returns the pictures of eyes with their channels.
ClippedPictures clipped_pictures(const Eyes& eyes, const EyeImages& pictures,
                                 const FrameSensors& sensors);

// Combines the pictures of two eyes in one frame.
EyeImages images_of_eyes(const FrameImage& left, FrameImage right, float min_transmittance);

// Memory of a batch in progress: copies of its cameras, and counts of its images.
struct BatchTables {
    BatchTables(uint32_t num_cameras, cudaStream_t stream)
        : cameras(num_cameras, stream), counts(num_cameras, stream) {}

    DeviceBuffer<BatchCamera> cameras;
    DeviceBuffer<ImageCounts> counts;
};

class BatchDrawing;

// Draws a scene whose tables are on the device. It selects a cut and draws it.
class SceneFrame {
  public:
    // Sets the gaussians of each bundle of the scene. Also sets the colours of the
    // bundles' clusters, unless `palettes` is empty. Host memory is copied before the
    // function returns.
    void set_models(std::vector<DeviceModel> models,
                    std::vector<std::shared_ptr<const DevicePalette>> palettes,
                    cudaStream_t stream);

    // Enqueues a plain request (FrameRequest::is_plain). `pictures` describes the
    // pictures, and `sensors` their channels and meshes. `place` sets the destinations.
    // With `pages`, pages that are ready are brought in first, and then the resident
    // part of the pool's bundles is drawn. `rule` is the request's rule after the
    // pacing of a budget; on return, it is the rule that was used.
    //
    // The scene, the pool and a given cut must exist until the drawing is finished. A
    // given cut must be on the device, and allows only one picture. If the frame is
    // drawn again, it uses the pages that are resident at that time.
    std::unique_ptr<Drawing> draw(const SceneTables& scene, DevicePages* pages,
                                  const FrameRequest& request, SelectRule& rule,
                                  const EyeImages& pictures, const FrameSensors& sensors,
                                  cudaStream_t stream, const Frame::Place& place);

    // Draws a picture for each camera of a batch, in parts if the batch is large.
    // Unlike draw(), it writes to the planes of the request. The first kernels read the
    // cameras.
    std::unique_ptr<BatchDrawing> draw_batch(const SceneTables& scene, const BatchRequest& request,
                                             const CameraArrays& arrays, uint32_t num_cameras,
                                             cudaStream_t stream);

    // Returns the device memory in bytes, one entry per purpose, without the models.
    std::vector<std::pair<const char*, size_t>> bytes() const;

  private:
    friend class BatchDrawing;
    // Returns memory that is not used by another batch in progress.
    std::shared_ptr<BatchTables> tables_for(uint32_t num_cameras, cudaStream_t stream);
    // Draws cameras [first, first + count) of a batch.
    std::unique_ptr<Drawing> draw_part(const BatchDrawing& batch, uint32_t first, uint32_t count,
                                       CameraSource source);
    // Halves the number of cameras of later parts (part_limit.h).
    void halve_parts(uint32_t num_cameras);

    std::unique_ptr<Drawing> draw_selected(const SceneTables& scene, const Eyes& eyes,
                                           const SelectRule& rule, const EyeImages& pictures,
                                           const FrameSensors& sensors, cudaStream_t stream,
                                           const Frame::Place& place);
    std::unique_ptr<Drawing> draw_resident(const SceneTables& scene, DevicePages& pages,
                                           const Eyes& eyes, SelectRule& rule,
                                           const EyeImages& pictures, const FrameSensors& sensors,
                                           cudaStream_t stream, const Frame::Place& place);
    std::unique_ptr<Drawing> draw_given(const SceneTables& scene, const FrameRequest& request,
                                        const EyeImages& pictures, const FrameSensors& sensors,
                                        cudaStream_t stream, const Frame::Place& place);
    // Returns the models that a frame without a pool draws.
    DrawnModels drawn_models() const;
    // Returns the input of a frame that draws the models.
    FrameBatch batch(const SceneTables& scene, const EyeImages& pictures, const SelectRule& rule,
                     const FrameSensors& sensors, cudaStream_t stream);

    std::vector<DeviceModel> models_;
    std::vector<std::shared_ptr<const DevicePalette>> palettes_;
    DeviceBuffer<GaussianRows<const float>> rows_;
    DeviceBuffer<PackedPlanes> packed_;
    DeviceBuffer<CodedGaussians> coded_;
    bool has_packed_ = false, has_coded_ = false;
    DeviceBuffer<Placement> placements_;
    DeviceBuffer<InstanceFactors> factors_;  // one element per instance slot of a batch
    DeviceBuffer<FrameImage> images_;
    PartLimit part_limit_;
    std::vector<std::shared_ptr<BatchTables>> tables_;  // memory of batches
    // Memory that captured graphs still use.
    std::vector<std::shared_ptr<BatchTables>> captured_tables_;
    Cut cut_;
    ClippedPass clipped_;
    Frame frame_;
};

// A batch that was enqueued. Its frame, scene and planes must outlive it.
class BatchDrawing {
  public:
    // Waits until the device has finished. Parts may still be missing: finish() draws
    // them again if a buffer was too small.
    void wait() const;
    // Waits until the pictures are drawn. Parts for which a buffer was too small are
    // drawn again, in smaller parts if memory does not suffice. Throws OutOfMemory or
    // std::length_error if memory does not even suffice for one camera.
    void finish();
    // Waits, and returns the counts of each image. Call it after finish().
    std::vector<ImageCounts> counts() const;
    // Returns the times summed over all parts. Call it after finish().
    FrameTimes times() const;
    size_t num_parts() const { return parts_.size(); }
    bool is_captured() const { return is_captured_; }

  private:
    friend class SceneFrame;
    struct Part {
        uint32_t first, count;
        std::unique_ptr<Drawing> drawing;
    };
    BatchDrawing(SceneFrame& frame, const SceneTables& scene, const BatchRequest& request,
                 const CameraArrays& arrays, uint32_t num_cameras, cudaStream_t stream);
    // Draws the cameras from `first` on, in parts.
    void enqueue(uint32_t first, uint32_t count);
    void finish_part(Part part, std::vector<Part>& finished);

    SceneFrame& frame_;
    const SceneTables& scene_;
    const BatchRequest request_;
    const CameraArrays arrays_;
    const uint32_t num_cameras_;
    const std::shared_ptr<BatchTables> tables_;
    const cudaStream_t stream_;
    const bool is_captured_;
    std::vector<Part> parts_;
};

// A model, and its placement in front of the camera.
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
                                  const Frame::Place& place = {}, const FrameSensors& sensors = {},
                                  const ClippedPictures& clipped = {});
    FrameTape tape() const { return frame_.tape(); }

  private:
    DeviceBuffer<ModelTables> tables_;
    Frame frame_;
};

}  // namespace cuda
}  // namespace v3dg
