// Follows a part through a film with the model-based tracker of ViSP:
//
//   visp_track FOLDER edge|edge+klt scan-line|normals OUTPUT
//
// FOLDER holds task.txt, frames/NNNNNN.png, model.cao and smooth.txt; lengths are in metres. Writes a line for each frame
// until the part is lost: CPU time of track() in ms, and the 3x4 pose, row by row. Reading pictures, and choosing which
// smooth edges are a silhouette, are not in the time.

#include <cmath>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <iostream>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include <opencv2/core.hpp>
#include <visp3/core/vpConfig.h>
#include <visp3/core/vpException.h>
#include <visp3/io/vpImageIo.h>
#include <visp3/mbt/vpMbGenericTracker.h>

namespace {

struct Task {
  int count, width, height;
  double fx, fy, cx, cy;
  vpHomogeneousMatrix pose;
};

Task readTask(const std::string &path) {
  std::ifstream file(path);
  Task task;
  file >> task.count >> task.width >> task.height >> task.fx >> task.fy >> task.cx >> task.cy;
  for (unsigned int row = 0; row < 3; ++row)
    for (unsigned int column = 0; column < 4; ++column)
      file >> task.pose[row][column];
  if (!file)
    throw std::runtime_error(path + ": cannot be read");
  return task;
}

double cpuMs() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return 1e3 * now.tv_sec + 1e-6 * now.tv_nsec;
}

// Edges that are not sharp: they are followed only where one side faces the camera and the other does not.
class SmoothEdges {
public:
  SmoothEdges(const std::string &path, vpMbGenericTracker &tracker) {
    std::map<Key, Edge> known;
    std::ifstream file(path);
    double v[12];
    while (read(file, v)) {
      const Edge edge{nullptr, {v[0], v[1], v[2]}, {v[6], v[7], v[8]}, {v[9], v[10], v[11]}, true};
      known[key({v[0], v[1], v[2]}, {v[3], v[4], v[5]})] = edge;
    }
    std::list<vpMbtDistanceLine *> lines;
    tracker.getLline(lines);
    for (vpMbtDistanceLine *line : lines) {
      const auto found = known.find(key(at(*line->p1), at(*line->p2)));
      if (found != known.end()) {
        edges_.push_back(found->second);
        edges_.back().line = line;
      }
    }
  }

  void choose(const vpHomogeneousMatrix &pose) {
    const vpHomogeneousMatrix inverse = pose.inverse();
    const std::vector<double> camera{inverse[0][3], inverse[1][3], inverse[2][3]};
    for (Edge &edge : edges_) {
      const bool is_silhouette = facing(edge.one, edge.point, camera) != facing(edge.other, edge.point, camera);
      if (is_silhouette == edge.is_followed)
        continue;
      edge.is_followed = is_silhouette;
      edge.line->Lindex_polygon_tracked.assign(edge.line->Lindex_polygon_tracked.size(), is_silhouette);
      edge.line->setTracked("", is_silhouette); // no polygon has this name: takes over what was assigned
    }
  }

private:
  using Key = std::vector<long>;
  struct Edge {
    vpMbtDistanceLine *line;
    std::vector<double> point, one, other;
    bool is_followed;
  };

  static bool read(std::ifstream &file, double *values) {
    for (int k = 0; k < 12; ++k)
      file >> values[k];
    return bool(file);
  }

  static std::vector<double> at(const vpPoint &point) { return {point.get_oX(), point.get_oY(), point.get_oZ()}; }

  static Key key(const std::vector<double> &a, const std::vector<double> &b) {
    Key one, other;
    for (int k = 0; k < 3; ++k) {
      one.push_back(std::lround(1e7 * a[k]));
      other.push_back(std::lround(1e7 * b[k]));
    }
    if (other < one)
      std::swap(one, other);
    one.insert(one.end(), other.begin(), other.end());
    return one;
  }

  static bool facing(const std::vector<double> &normal, const std::vector<double> &point,
                     const std::vector<double> &camera) {
    double along = 0.0;
    for (int k = 0; k < 3; ++k)
      along += normal[k] * (camera[k] - point[k]);
    return along > 0.0;
  }

  std::vector<Edge> edges_;
};

void setUp(vpMbGenericTracker &tracker, const Task &task, bool has_klt, bool is_scan_line) {
  vpMe edges;
  edges.setMaskSize(5);
  edges.setMaskNumber(180);
  edges.setRange(10);
  edges.setMu1(0.5);
  edges.setMu2(0.5);
  edges.setSampleStep(4);
#if VISP_VERSION_INT >= VP_VERSION_INT(3, 6, 0)
  edges.setLikelihoodThresholdType(vpMe::NORMALIZED_THRESHOLD);
  edges.setThreshold(20);
#else
  edges.setThreshold(10000);
#endif
  tracker.setMovingEdge(edges);
  if (has_klt) {
    vpKltOpencv klt;
    klt.setMaxFeatures(10000);
    klt.setWindowSize(5);
    klt.setQuality(0.01);
    klt.setMinDistance(5);
    klt.setHarrisFreeParameter(0.02);
    klt.setBlockSize(3);
    klt.setPyramidLevels(3);
    tracker.setKltOpencv(klt);
    tracker.setKltMaskBorder(5);
  }
  vpCameraParameters camera;
  camera.initPersProjWithoutDistortion(task.fx, task.fy, task.cx, task.cy);
  tracker.setCameraParameters(camera);
  tracker.setAngleAppear(vpMath::rad(85.0));
  tracker.setAngleDisappear(vpMath::rad(89.0));
  tracker.setNearClippingDistance(0.01);
  tracker.setFarClippingDistance(20.0);
  tracker.setClipping(tracker.getClipping() | vpMbtPolygon::FOV_CLIPPING);
  tracker.setScanLineVisibilityTest(is_scan_line);
  tracker.setDisplayFeatures(false);
}

int run(const std::string &folder, bool has_klt, bool is_scan_line, const std::string &output) {
  const Task task = readTask(folder + "/task.txt");
  const int kind = vpMbGenericTracker::EDGE_TRACKER | (has_klt ? vpMbGenericTracker::KLT_TRACKER : 0);
  vpMbGenericTracker tracker(1, kind);
  setUp(tracker, task, has_klt, is_scan_line);
  tracker.loadModel(folder + "/model.cao");
  SmoothEdges smooth(folder + "/smooth.txt", tracker);
  smooth.choose(task.pose);
  std::ofstream out(output);
  out.precision(12);
  for (int index = 0; index < task.count; ++index) {
    char name[16];
    std::snprintf(name, sizeof(name), "%06d.png", index);
    vpImage<unsigned char> image;
    vpImageIo::read(image, folder + "/frames/" + name);
    vpHomogeneousMatrix pose;
    double spent = 0.0;
    try {
      if (index == 0)
        tracker.initFromPose(image, task.pose);
      const double began = cpuMs();
      tracker.track(image);
      tracker.getPose(pose);
      spent = cpuMs() - began;
    } catch (const vpException &error) {
      std::cerr << "frame " << index << ": " << error.what() << "\n";
      break;
    }
    smooth.choose(pose);
    out << spent;
    for (unsigned int row = 0; row < 3; ++row)
      for (unsigned int column = 0; column < 4; ++column)
        out << " " << pose[row][column];
    out << "\n";
  }
  return out ? 0 : 1;
}

} // namespace

int main(int count, char **words) {
  if (count != 5) {
    std::cerr << "visp_track FOLDER edge|edge+klt scan-line|normals OUTPUT\n";
    return 2;
  }
  cv::setNumThreads(1);
  try {
    return run(words[1], std::string(words[2]) == "edge+klt", std::string(words[3]) == "scan-line", words[4]);
  } catch (const std::exception &error) {
    std::cerr << error.what() << "\n";
    return 1;
  }
}
