import fusion_gym

card = fusion_gym.zoo.card("tobit_oscillator_scheduler")
print(card["env"], card["options"])
for price, point in zip(card["test"]["prices"], card["test"]["points"], strict=True):
    print(f"{price:<7.3g} cost {point['cost']:.3f}  MSE {point['mse']:.3f}")
