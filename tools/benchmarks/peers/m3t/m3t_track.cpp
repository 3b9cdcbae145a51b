// Follows a part through a film with the region modality of M3T and a colour camera:
//
//   m3t_track FOLDER default|rbot MESH VIEWS OUTPUT
//
// FOLDER holds task.txt and frames/NNNNNN.png; lengths are in metres. VIEWS is M3T's own file of views of the mesh, made
// where it is missing, which takes OpenGL. Writes a line for each frame: CPU time in ms, and the 3x4 pose, row by row.
// Reading pictures and making views are not in the time.

#include <ctime>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <memory>
#include <string>

#include <m3t/body.h>
#include <m3t/common.h>
#include <m3t/link.h>
#include <m3t/loader_camera.h>
#include <m3t/optimizer.h>
#include <m3t/region_modality.h>
#include <m3t/region_model.h>
#include <m3t/tracker.h>
#include <opencv2/core.hpp>

namespace {

double cpuMs() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return 1e3 * now.tv_sec + 1e-6 * now.tv_nsec;
}

int failed(const char *what) {
  std::cerr << what << " failed\n";
  return 1;
}

// What the authors use for the RBOT data set, where it differs from the defaults.
void useRbotSettings(m3t::RegionModality &region, m3t::Tracker &tracker) {
  region.set_function_amplitude(0.36f);
  region.set_function_slope(0.0f);
  region.set_scales({5, 2, 2, 1});
  region.set_standard_deviations({20.0f, 7.0f, 3.0f, 1.5f});
  region.set_n_histogram_bins(32);
  tracker.set_n_corr_iterations(7);
}

int run(const std::filesystem::path &folder, bool is_rbot, const std::filesystem::path &mesh,
        const std::filesystem::path &views, const std::string &output) {
  std::ifstream task(folder / "task.txt");
  int count = 0;
  m3t::Intrinsics camera;
  task >> count >> camera.width >> camera.height >> camera.fu >> camera.fv >> camera.ppu >> camera.ppv;
  m3t::Transform3fA pose = m3t::Transform3fA::Identity();
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 4; ++column)
      task >> pose.matrix()(row, column);
  if (!task)
    return failed("reading task.txt");
  pose.linear() = Eigen::Quaternionf(pose.linear()).normalized().toRotationMatrix();

  const m3t::Transform3fA same = m3t::Transform3fA::Identity();
  auto body = std::make_shared<m3t::Body>("body", mesh, 1.0f, true, false, same);
  if (!body->SetUp())
    return failed("the body");
  auto model = std::make_shared<m3t::RegionModel>("model", body, views);
  if (!model->SetUp())
    return failed("the region model");
  auto colour = std::make_shared<m3t::LoaderColorCamera>("colour", folder / "frames", camera, "", 0, 6);
  auto region = std::make_shared<m3t::RegionModality>("region", body, colour, model);
  auto link = std::make_shared<m3t::Link>("link", body);
  link->AddModality(region);
  auto tracker = std::make_shared<m3t::Tracker>("tracker");
  tracker->AddOptimizer(std::make_shared<m3t::Optimizer>("optimizer", link));
  if (is_rbot)
    useRbotSettings(*region, *tracker);
  if (!tracker->SetUp()) // reads the first frame
    return failed("the tracker");
  link->set_link2world_pose(pose);
  body->set_body2world_pose(pose);
  tracker->StartTracking();

  std::ofstream out(output);
  out.precision(9);
  for (int index = 0; index < count; ++index) {
    if (index > 0 && !tracker->UpdateCameras(index))
      return failed("reading a frame");
    const double began = cpuMs();
    if (!tracker->ExecuteStartingStep(index) || !tracker->ExecuteTrackingStep(index))
      return failed("a step");
    out << cpuMs() - began;
    for (int row = 0; row < 3; ++row)
      for (int column = 0; column < 4; ++column)
        out << " " << body->body2world_pose().matrix()(row, column);
    out << "\n";
  }
  return out ? 0 : 1;
}

} // namespace

int main(int count, char **words) {
  if (count != 6) {
    std::cerr << "m3t_track FOLDER default|rbot MESH VIEWS OUTPUT\n";
    return 2;
  }
  cv::setNumThreads(1);
  return run(words[1], std::string(words[2]) == "rbot", words[3], words[4], words[5]);
}
