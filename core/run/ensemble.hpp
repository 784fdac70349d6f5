#pragma once
// Many independent tasks of unequal cost on several threads.

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

namespace invariode {

/// The indices that a worker has still to do. The owner takes from the front; a worker with nothing left takes the
/// back half. Both ends are in one word, so that each is one compare-and-swap.
class alignas(64) Share {
 public:
  void assign(std::uint32_t begin, std::uint32_t end) { ends_.store(pack(begin, end)); }

  /// The next index; false: none is left.
  bool take(std::uint32_t& index) {
    std::uint64_t ends = ends_.load();
    do {
      if (begin(ends) >= end(ends)) return false;
      index = begin(ends);
    } while (!ends_.compare_exchange_weak(ends, pack(index + 1, end(ends))));
    return true;
  }

  /// Moves the back half, at least one index, to `thief`, which must be empty; false: there is nothing.
  bool steal(Share& thief) {
    std::uint64_t ends = ends_.load();
    std::uint32_t middle;
    do {
      if (begin(ends) >= end(ends)) return false;
      middle = begin(ends) + (end(ends) - begin(ends)) / 2;
    } while (!ends_.compare_exchange_weak(ends, pack(begin(ends), middle)));
    thief.assign(middle, end(ends));
    return true;
  }

 private:
  static std::uint64_t pack(std::uint32_t begin, std::uint32_t end) { return std::uint64_t{begin} << 32 | end; }
  static std::uint32_t begin(std::uint64_t ends) { return static_cast<std::uint32_t>(ends >> 32); }
  static std::uint32_t end(std::uint64_t ends) { return static_cast<std::uint32_t>(ends); }

  std::atomic<std::uint64_t> ends_ = 0;
};

/// Calls work(worker, index, cancelled) for each index < count, on `workers` threads; meanwhile, every `patience` and
/// at the end, watch(done) on the calling thread, which cancels what is left by returning false. True: all were done.
/// `cancelled` is for work that takes long. What work throws first cancels the others and is thrown again.
template <class Work, class Watch>
bool for_each_index(std::uint32_t count, std::size_t workers, std::chrono::milliseconds patience, Work work,
                    Watch watch) {
  std::vector<Share> shares(workers);
  for (std::size_t w = 0; w < workers; ++w)
    shares[w].assign(static_cast<std::uint32_t>(std::uint64_t{count} * w / workers),
                     static_cast<std::uint32_t>(std::uint64_t{count} * (w + 1) / workers));
  std::atomic<bool> cancelled = false;
  std::atomic<std::uint32_t> done = 0;
  std::mutex mutex;
  std::condition_variable ended;
  std::size_t running = workers;
  std::exception_ptr error;

  const auto labour = [&](std::size_t own) {
    const auto steal = [&] {
      for (std::size_t k = 1; k < workers; ++k)
        if (shares[(own + k) % workers].steal(shares[own])) return true;
      return false;
    };
    do {
      for (std::uint32_t index; !cancelled.load(std::memory_order_relaxed) && shares[own].take(index);) {
        try {
          work(own, index, cancelled);
        } catch (...) {
          const std::lock_guard lock(mutex);
          if (!error) error = std::current_exception();
          cancelled = true;
        }
        done.fetch_add(1, std::memory_order_relaxed);
      }
    } while (!cancelled.load(std::memory_order_relaxed) && steal());
    const std::lock_guard lock(mutex);
    --running;
    ended.notify_one();
  };

  std::vector<std::thread> threads;
  threads.reserve(workers);
  try {
    for (std::size_t w = 0; w < workers; ++w) threads.emplace_back(labour, w);
  } catch (...) {  // no more threads to be had: those that run take the others' shares
    if (threads.empty()) throw;
    const std::lock_guard lock(mutex);
    running -= workers - threads.size();
  }
  {
    std::unique_lock lock(mutex);
    while (!ended.wait_for(lock, patience, [&] { return running == 0; })) {
      lock.unlock();
      if (!watch(done.load())) cancelled = true;
      lock.lock();
    }
  }
  for (std::thread& thread : threads) thread.join();
  if (error) std::rethrow_exception(error);
  return watch(done.load()) && !cancelled;
}

}  // namespace invariode
